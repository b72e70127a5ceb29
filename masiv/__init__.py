"""masiv: digital twins of moving, deforming objects, from multi-view video or tracked points."""

import os

# torch's threads spin while they wait for each other and for Taichi's, which makes a busy machine ten times slower;
# read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
