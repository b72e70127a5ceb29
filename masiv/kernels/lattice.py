"""The lattice of strain features on which the networks of the neural law are evaluated, and which kernels interpolate.

Axes: signed volume, size of the shear, kind of the shear (``masiv.materials.neural.NeuralLaw.features``). F = I is a
node. Features are logarithms of strains, so the lattice reaches volume changes by e^4 and stretches by e^6.
"""

LATTICE_STEP = 0.25
LATTICE_LOWER = (-6.0, 0.0, -1.0)
LATTICE_COUNTS = (49, 33, 9)
