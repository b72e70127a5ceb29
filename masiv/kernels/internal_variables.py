"""Internal variables of the particles: what a stress with a history remembers."""

import taichi as ti


@ti.data_oriented
class InternalVariables:
    """``values[s, p, b]`` (size,): those of branch b of particle p before substep s. ``c[p, b]`` (coefficients,): what
    its function depends on. ``bar[p, b]``: the adjoint of the values, of one substep at a time. ``started``: 0 if
    substep 0 is the first of a rollout, where nothing is remembered. They are kept for all substeps, beyond the
    simulator's ``memory_mb``."""

    def __init__(self, mpm, branches: int, size: int, coefficients: int):
        self.mpm = mpm
        self.branches = branches
        self.size = size
        self.coefficients = coefficients
        steps, particles, real = mpm.capacity_steps, mpm.capacity_particles, mpm.real
        self.values = ti.Vector.field(size, real, shape=(steps + 1, particles, branches))
        self.c = ti.Vector.field(coefficients, real, shape=(particles, branches))
        self.bar = ti.Vector.field(size, real, shape=(particles, branches))
        self.started = ti.field(ti.i32, shape=())

    @ti.func
    def known(self, s: ti.i32):
        """1, or 0 in the first substep of a rollout."""
        out = ti.cast(1.0, self.mpm.real)
        if s == 0 and self.started[None] == 0:
            out = ti.cast(0.0, self.mpm.real)
        return out

    @ti.kernel
    def write_coefficients(self, values: ti.types.ndarray()):
        """values (N, branches * coefficients), branch after branch."""
        for p in range(values.shape[0]):
            for b in range(self.branches):
                for i in ti.static(range(self.coefficients)):
                    self.c[p, b][i] = values[p, b * self.coefficients + i]

    @ti.kernel
    def write(self, values: ti.types.ndarray()):
        """values (N, branches * size), before substep 0."""
        for p in range(values.shape[0]):
            for b in range(self.branches):
                for i in ti.static(range(self.size)):
                    self.values[0, p, b][i] = values[p, b * self.size + i]

    @ti.kernel
    def clear(self, count: ti.i32):
        for p, b in ti.ndrange(count, self.branches):
            self.values[0, p, b] = ti.Vector.zero(self.mpm.real, self.size)

    @ti.kernel
    def read(self, s: ti.i32, out: ti.types.ndarray()):
        """out (N, branches * size), before substep s."""
        for p in range(out.shape[0]):
            for b in range(self.branches):
                for i in ti.static(range(self.size)):
                    out[p, b * self.size + i] = self.values[s, p, b][i]

    @ti.kernel
    def clear_bar(self, count: ti.i32):
        for p, b in ti.ndrange(count, self.branches):
            self.bar[p, b] = ti.Vector.zero(self.mpm.real, self.size)
