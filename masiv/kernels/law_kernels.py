"""Kernels that apply a classical law, or one in strain invariants, to the fields of a simulator; and their adjoints."""

import taichi as ti

from masiv import runtime
from masiv.kernels import isotropic
from masiv.kernels.laws import law_function


@ti.data_oriented
class ClassicalKernels:
    """A law that maps (trial gradient, coefficients) to (elastic gradient, stress) in one pointwise function.

    The adjoint is Taichi's, on fields of one substep, so that only those carry gradients. Coefficients are per
    particle: no two particles add to the same gradient, and no float atomic is needed.
    """

    def __init__(self, mpm, kind: str, coefficients: int):
        self.mpm = mpm
        self.owner = None  # the rollout whose coefficients the field holds
        self.law = law_function(kind)
        self.n_coefficients = coefficients
        capacity, real = mpm.capacity_particles, mpm.real
        self.trial = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.gradient = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.stress = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.coefficients = ti.Vector.field(coefficients, real, shape=capacity, needs_grad=True)

    @ti.kernel
    def write_coefficients(self, values: ti.types.ndarray()):
        """values: (N, K). Their gradients start at zero."""
        for p in range(values.shape[0]):
            for c in ti.static(range(self.n_coefficients)):
                self.coefficients[p][c] = values[p, c]
                self.coefficients.grad[p][c] = 0.0

    @ti.kernel
    def read_coefficient_gradients(self, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            for c in ti.static(range(self.n_coefficients)):
                out[p, c] = self.coefficients.grad[p][c]

    @ti.func
    def flow_particle(self, s: ti.i32, p: ti.i32):
        """The stress, too: both come from one decomposition of the strain."""
        f, tau = self.law(self.mpm.trial_gradient[s, p], self.coefficients[p])
        self.mpm.deformation_gradient[s, p] = f
        self.mpm.kirchhoff_stress[s, p] = tau

    @ti.func
    def stress_particle(self, s: ti.i32, p: ti.i32):
        """Nothing is left to do."""

    @ti.kernel
    def forward(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.flow_particle(s, p)

    @ti.kernel
    def pointwise(self, count: ti.i32):
        for p in range(count):
            f, tau = self.law(self.trial[p], self.coefficients[p])
            self.gradient[p] = f
            self.stress[p] = tau

    @ti.kernel
    def load_adjoint(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.trial[p] = self.mpm.trial_gradient[s, p]
            self.trial.grad[p] = ti.Matrix.zero(self.mpm.real, 3, 3)
            self.gradient.grad[p] = self.mpm.gradient_bar[p]
            self.stress.grad[p] = self.mpm.stress_bar[p]

    @ti.kernel
    def store_adjoint(self, count: ti.i32):
        for p in range(count):
            self.mpm.trial_bar[p] = self.trial.grad[p]

    def backward(self, s: int, count: int) -> None:
        self.load_adjoint(s, count)
        runtime.adjoint(self.pointwise, count)
        self.store_adjoint(count)


@ti.data_oriented
class InvariantKernels:
    """A law whose coefficients are functions of the strain invariants, evaluated in torch between two kernels.

    share (N, 2) are the coefficients of ``isotropic.flow``, moduli (N, 4) those of ``isotropic.stress``. The
    adjoints are by hand: Taichi's autodiff takes minutes to compile the inverses.
    """

    def __init__(self, mpm):
        self.mpm = mpm

    @ti.kernel
    def trial_invariants(self, s: ti.i32, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            value = isotropic.invariants(isotropic.isochoric_strain(self.mpm.trial_gradient[s, p]))
            for a in ti.static(range(3)):
                out[p, a] = value[a]

    @ti.kernel
    def final_invariants(self, s: ti.i32, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            value = isotropic.invariants(isotropic.isochoric_strain(self.mpm.deformation_gradient[s, p]))
            for a in ti.static(range(3)):
                out[p, a] = value[a]

    @ti.kernel
    def flow(self, s: ti.i32, share: ti.types.ndarray(), out: ti.types.ndarray()):
        """Apply the flow, and write the invariants (N, 3) of the remaining strain."""
        for p in range(out.shape[0]):
            trial, c = self.mpm.trial_gradient[s, p], ti.Vector([share[p, 0], share[p, 1]])
            f = isotropic.flow(trial, isotropic.isochoric_strain(trial), c)
            self.mpm.deformation_gradient[s, p] = f
            value = isotropic.invariants(isotropic.isochoric_strain(f))
            for a in ti.static(range(3)):
                out[p, a] = value[a]

    @ti.kernel
    def elastic(self, s: ti.i32, moduli: ti.types.ndarray()):
        for p in range(moduli.shape[0]):
            c = ti.Vector([moduli[p, 0], moduli[p, 1], moduli[p, 2], moduli[p, 3]])
            strain = isotropic.isochoric_strain(self.mpm.deformation_gradient[s, p])
            self.mpm.kirchhoff_stress[s, p] = isotropic.stress(strain, c)

    @ti.kernel
    def elastic_adjoint(self, s: ti.i32, moduli: ti.types.ndarray(), moduli_bar: ti.types.ndarray()):
        """``stress_bar`` -> added to ``gradient_bar``, and moduli_bar (N, 4)."""
        for p in range(moduli.shape[0]):
            c = ti.Vector([moduli[p, 0], moduli[p, 1], moduli[p, 2], moduli[p, 3]])
            f = self.mpm.deformation_gradient[s, p]
            strain = isotropic.isochoric_strain(f)
            c_bar, log_j_bar, b_bar, b_inverse_bar = isotropic.stress_adjoint(strain, c, self.mpm.stress_bar[p])
            self.mpm.gradient_bar[p] += isotropic.strain_adjoint(f, strain, log_j_bar, b_bar, b_inverse_bar)
            for a in ti.static(range(4)):
                moduli_bar[p, a] = c_bar[a]

    @ti.kernel
    def flow_adjoint(
        self, s: ti.i32, share: ti.types.ndarray(), final_bar: ti.types.ndarray(), share_bar: ti.types.ndarray()
    ):
        """``gradient_bar`` and the adjoint (N, 3) of the final invariants -> ``trial_bar``, and share_bar (N, 2)."""
        for p in range(share.shape[0]):
            trial, out = self.mpm.trial_gradient[s, p], self.mpm.deformation_gradient[s, p]
            bar = ti.Vector([final_bar[p, 0], final_bar[p, 1], final_bar[p, 2]])
            out_bar = self.mpm.gradient_bar[p] + isotropic.invariants_adjoint(out, bar)
            c, strain = ti.Vector([share[p, 0], share[p, 1]]), isotropic.isochoric_strain(trial)
            c_bar, f_bar, log_j_bar, b_bar, b_inverse_bar = isotropic.flow_adjoint(trial, strain, c, out, out_bar)
            self.mpm.trial_bar[p] = f_bar + isotropic.strain_adjoint(trial, strain, log_j_bar, b_bar, b_inverse_bar)
            for a in ti.static(range(2)):
                share_bar[p, a] = c_bar[a]

    @ti.kernel
    def add_trial_invariants_adjoint(self, s: ti.i32, bar: ti.types.ndarray()):
        """The adjoint (N, 3) of the trial invariants -> added to ``trial_bar``."""
        for p in range(bar.shape[0]):
            value = ti.Vector([bar[p, 0], bar[p, 1], bar[p, 2]])
            self.mpm.trial_bar[p] += isotropic.invariants_adjoint(self.mpm.trial_gradient[s, p], value)
