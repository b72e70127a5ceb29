"""Kernels that apply a classical law to the fields of a simulator, and their adjoints."""

import taichi as ti

from masiv.kernels import tensor


@ti.data_oriented
class ClassicalKernels:
    """A law that maps (trial gradient, coefficients) to (elastic gradient, stress) in one pointwise function.

    The adjoint is Taichi's, on fields of one substep, so that only those carry gradients. Coefficients are per
    particle: no two particles add to the same gradient, and no float atomic is needed.
    """

    def __init__(self, mpm, kind: str, coefficients: int):
        self.mpm = mpm
        self.owner = None  # the rollout whose coefficients the field holds
        self.law = tensor.CLASSICAL[kind]
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

    @ti.kernel
    def forward(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            f, tau = self.law(self.mpm.trial_gradient[s, p], self.coefficients[p])
            self.mpm.deformation_gradient[s, p] = f
            self.mpm.kirchhoff_stress[s, p] = tau

    @ti.kernel
    def forward_p2g(self, s: ti.i32, count: ti.i32, nodes: ti.i32):
        """``forward`` and the P2G of a CPU in one pass: a launch and a trip through memory less."""
        ti.loop_config(block_dim=1)
        for t in range(self.mpm.chunks):
            for n in range(nodes):
                self.mpm.private[t, n] = ti.Vector.zero(self.mpm.real, 4)
            for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
                f, tau = self.law(self.mpm.trial_gradient[s, p], self.coefficients[p])
                self.mpm.deformation_gradient[s, p] = f
                self.mpm.kirchhoff_stress[s, p] = tau
                self.mpm.p2g_particle(t, s, p)

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
        self.pointwise.grad(count)
        self.store_adjoint(count)
