"""Carries gradients and stresses between the fields of a simulator and torch, for laws without kernels of their own."""

import taichi as ti


@ti.data_oriented
class PointwiseKernels:
    def __init__(self, mpm):
        self.mpm = mpm

    @ti.kernel
    def read_trial(self, s: ti.i32, out: ti.types.ndarray()):
        """Trial gradients (N, 3, 3) at substep s."""
        for p in range(out.shape[0]):
            for a, b in ti.static(ti.ndrange(3, 3)):
                out[p, a, b] = self.mpm.trial_gradient[s, p][a, b]

    @ti.kernel
    def write(self, s: ti.i32, gradient: ti.types.ndarray(), stress: ti.types.ndarray()):
        """Elastic gradients and Kirchhoff stresses [Pa] (N, 3, 3) at substep s."""
        for p in range(gradient.shape[0]):
            for a, b in ti.static(ti.ndrange(3, 3)):
                self.mpm.deformation_gradient[s, p][a, b] = gradient[p, a, b]
                self.mpm.kirchhoff_stress[s, p][a, b] = stress[p, a, b]
