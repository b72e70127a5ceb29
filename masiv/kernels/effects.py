"""Kernels of an effect on the grid, on the stress or on the particles, for the adjoint of a substep; the pointwise part
of the adjoint is by Taichi's autodiff. The forward substep has kernels of its own: ``masiv.kernels.forward_effects``.

An effect's function is pointwise: a node's or a particle's. Its coefficients are copied to every node or particle, so
that no two of them add to the same gradient.
"""

import taichi as ti

from masiv import runtime
from masiv.kernels.grid import DT, DX, FRICTION, contact_adjoint, contact_velocity, momentum_of, two_floats


@ti.data_oriented
class OpenGrid:
    """The grid update of ``MpmKernels`` taken apart, so that effects can act between gravity and contact."""

    def __init__(self, mpm):
        self.mpm = mpm
        self.before = ti.Vector.field(3, mpm.real, shape=mpm.capacity_nodes)

    @ti.kernel
    def free(self, offset: ti.i32, nodes: ti.i32):
        """Velocity of the nodes after gravity, from the log at ``offset``."""
        for n in range(nodes):
            value = self.mpm.grid_momentum[offset + n]
            v = ti.Vector.zero(self.mpm.real, 3)
            if value[3] > 0.0:
                v = momentum_of(value) / value[3] + self.mpm.constants[DT] * self.mpm.gravity()
            self.mpm.grid_velocity[n] = ti.Vector([v[0], v[1], v[2], 0.0])

    @ti.kernel
    def contact(self, nodes: ti.i32):
        for n in range(nodes):
            v = momentum_of(self.mpm.grid_velocity[n])
            self.before[n] = v
            if self.mpm.grounded(n):
                v = contact_velocity(v, self.mpm.contact[None], self.mpm.constants[FRICTION])
            self.mpm.grid_velocity[n] = ti.Vector([v[0], v[1], v[2], 0.0])

    @ti.kernel
    def sum_bars(self, nodes: ti.i32):
        """What ``g2p_adjoint`` scattered -> ``grid_velocity_bar``."""
        for n in range(nodes):
            self.mpm.grid_velocity_bar[n] = momentum_of(self.mpm.sum_of_chunks(n))

    @ti.kernel
    def contact_adjoint(self, nodes: ti.i32):
        for n in range(nodes):
            if self.mpm.grounded(n):
                self.mpm.grid_velocity_bar[n] = contact_adjoint(
                    self.before[n], self.mpm.grid_velocity_bar[n], self.mpm.contact[None], self.mpm.constants[FRICTION]
                )

    @ti.kernel
    def momentum_adjoint(self, offset: ti.i32, nodes: ti.i32):
        """``grid_velocity_bar`` after gravity -> ``grid_momentum_bar``."""
        for n in range(nodes):
            out = ti.Vector.zero(self.mpm.real, 4)
            value = self.mpm.grid_momentum[offset + n]
            if value[3] > 0.0:
                bar = self.mpm.grid_velocity_bar[n]
                out = ti.Vector([bar[0], bar[1], bar[2], -bar.dot(momentum_of(value)) / value[3]]) / value[3]
            self.mpm.grid_momentum_bar[n] = out


@ti.data_oriented
class NodeKernels:
    """Function of ``NodalEffect.node_velocity`` or, if ``grounded``, ``ContactEffect.contact_velocity`` on the nodes of
    the grid. A grounded one is applied to nodes on or below the ground alone."""

    def __init__(self, mpm, function, coefficients: int, grounded: bool):
        self.mpm = mpm
        self.function = function
        self.grounded = grounded
        self.n = coefficients
        self.capacity = mpm.capacity_nodes
        self.before = ti.Vector.field(3, mpm.real, shape=self.capacity, needs_grad=True)
        self.held = ti.Vector.field(3, mpm.real, shape=self.capacity, needs_grad=True)
        self.after = ti.Vector.field(3, mpm.real, shape=self.capacity, needs_grad=True)
        # A copy a node; its gradient is summed over substeps in place, and over nodes when it is read.
        self.coefficients = ti.Vector.field(coefficients, mpm.real, shape=self.capacity, needs_grad=True)

    @ti.kernel
    def write(self, values: ti.types.ndarray()):
        """values (K,); the sums of their gradients start at zero."""
        for n in range(self.capacity):
            for i in ti.static(range(self.n)):
                self.coefficients[n][i] = values[i]
                self.coefficients.grad[n][i] = 0.0

    @ti.kernel
    def read_gradient(self, out: ti.types.ndarray()):
        """out (K,)."""
        total = ti.Vector.zero(self.mpm.real, self.n)
        ti.loop_config(serialize=True)  # in order: the sum is the same to the bit
        for n in range(self.capacity):
            total += self.coefficients.grad[n]
        for i in ti.static(range(self.n)):
            out[i] = total[i]

    @ti.func
    def concerns(self, n: ti.i32):
        out = True
        if ti.static(self.grounded):
            out = self.mpm.grounded(n)
        return out

    @ti.func
    def result(self, n: ti.i32, now):
        """The function at node n, of ``before``, ``held`` and ``coefficients``; now [s]."""
        dt, dx = self.mpm.constants[DT], self.mpm.constants[DX]
        x, v = self.mpm.node_position(n), self.before[n]
        if ti.static(self.grounded):
            return self.function(x, v, self.held[n], now, dt, dx, self.coefficients[n])
        else:
            return self.function(x, v, now, dt, dx, self.coefficients[n])

    @ti.kernel
    def apply_at(self, nodes: ti.i32, t: ti.f32, t_rest: ti.f32):
        for n in range(nodes):
            v = momentum_of(self.mpm.grid_velocity[n])
            self.before[n] = v
            if self.concerns(n):
                if ti.static(self.grounded):
                    self.held[n] = contact_velocity(v, self.mpm.contact[None], self.mpm.constants[FRICTION])
                out = self.result(n, self.mpm.sum_of_two(t, t_rest))
                self.mpm.grid_velocity[n] = ti.Vector([out[0], out[1], out[2], 0.0])

    @ti.kernel
    def load(self, nodes: ti.i32):
        zero = ti.Vector.zero(self.mpm.real, 3)
        for n in range(nodes):
            self.after.grad[n] = self.mpm.grid_velocity_bar[n]
            self.before.grad[n] = zero
            self.held.grad[n] = zero

    @ti.kernel
    def pointwise(self, nodes: ti.i32, t: ti.f32, t_rest: ti.f32):
        for n in range(nodes):
            if self.concerns(n):
                self.after[n] = self.result(n, self.mpm.sum_of_two(t, t_rest))
            else:
                self.after[n] = self.before[n]

    @ti.kernel
    def store(self, nodes: ti.i32):
        for n in range(nodes):
            bar = self.before.grad[n]
            if ti.static(self.grounded):
                bar += contact_adjoint(
                    self.before[n], self.held.grad[n], self.mpm.contact[None], self.mpm.constants[FRICTION]
                )
            self.mpm.grid_velocity_bar[n] = bar

    def apply(self, nodes: int, t: float) -> None:
        """``grid_velocity`` -> the same after the effect; t [s]."""
        self.apply_at(nodes, *two_floats(t))

    def adjoint(self, nodes: int, t: float) -> None:
        """``grid_velocity_bar`` after the effect -> before it, from ``before`` as ``apply`` left it."""
        self.load(nodes)
        runtime.adjoint(self.pointwise, nodes, *two_floats(t))
        self.store(nodes)


@ti.data_oriented
class ForceKernels:
    """The adjoint of a constant force (N, 3) [N] on the particles: v += dt f / m at the end of each substep."""

    def __init__(self, mpm):
        self.mpm = mpm
        self.force = ti.Vector.field(3, mpm.real, shape=mpm.capacity_particles)
        self.total = ti.Vector.field(3, mpm.real, shape=mpm.capacity_particles)

    @ti.kernel
    def write(self, values: ti.types.ndarray()):
        """values (N, 3); the sums of their gradients start at zero."""
        for p in range(values.shape[0]):
            for i in ti.static(range(3)):
                self.force[p][i] = values[p, i]
                self.total[p][i] = 0.0

    @ti.kernel
    def read_gradient(self, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            for i in ti.static(range(3)):
                out[p, i] = self.total[p][i]

    @ti.kernel
    def adjoint(self, s: ti.i32, count: ti.i32):
        """Sums up the adjoint; the velocities become what G2P wrote, of which its own adjoint is."""
        for p in range(count):
            per_force = self.mpm.constants[DT] / self.mpm.particle_mass[p]
            bar = self.mpm.velocity_bar[p]
            self.total[p] += per_force * bar
            self.mpm.mass_bar[p] -= per_force / self.mpm.particle_mass[p] * bar.dot(self.force[p])
            self.mpm.velocity[s, p] -= per_force * self.force[p]


@ti.data_oriented
class StressKernels:
    """``function(tau, F, C, c) -> tau`` on particles: Kirchhoff stress [Pa], elastic deformation gradient, affine
    velocity (the velocity gradient) [1/s], coefficients of the particle."""

    def __init__(self, mpm, function, coefficients: int):
        self.mpm = mpm
        self.function = function
        self.n = coefficients
        capacity, real = mpm.capacity_particles, mpm.real
        self.c = ti.Vector.field(coefficients, real, shape=capacity)
        self.total = ti.Vector.field(coefficients, real, shape=capacity)
        self.before = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.after = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.gradient = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.affine = ti.Matrix.field(3, 3, real, shape=capacity, needs_grad=True)
        self.coefficients = ti.Vector.field(coefficients, real, shape=capacity, needs_grad=True)

    @ti.kernel
    def write(self, values: ti.types.ndarray()):
        """values (N, K); the sums of their gradients start at zero."""
        for p in range(values.shape[0]):
            for i in ti.static(range(self.n)):
                self.c[p][i] = values[p, i]
                self.total[p][i] = 0.0

    @ti.kernel
    def read_gradient(self, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            for i in ti.static(range(self.n)):
                out[p, i] = self.total[p][i]

    @ti.kernel
    def apply(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            tau = self.mpm.kirchhoff_stress[s, p]
            self.before[p] = tau
            self.mpm.kirchhoff_stress[s, p] = self.function(
                tau, self.mpm.deformation_gradient[s, p], self.mpm.affine_velocity[s, p], self.c[p]
            )

    @ti.kernel
    def load(self, s: ti.i32, count: ti.i32):
        zero = ti.Matrix.zero(self.mpm.real, 3, 3)
        for p in range(count):
            self.gradient[p] = self.mpm.deformation_gradient[s, p]
            self.affine[p] = self.mpm.affine_velocity[s, p]
            self.coefficients[p] = self.c[p]
            self.after.grad[p] = self.mpm.stress_bar[p]
            self.before.grad[p] = zero
            self.gradient.grad[p] = zero
            self.affine.grad[p] = zero
            self.coefficients.grad[p] = ti.Vector.zero(self.mpm.real, self.n)

    @ti.kernel
    def pointwise(self, count: ti.i32):
        for p in range(count):
            self.after[p] = self.function(self.before[p], self.gradient[p], self.affine[p], self.coefficients[p])

    @ti.kernel
    def store(self, count: ti.i32):
        for p in range(count):
            self.mpm.stress_bar[p] = self.before.grad[p]
            self.mpm.gradient_bar[p] += self.gradient.grad[p]
            self.mpm.affine_bar[p] += self.affine.grad[p]
            self.total[p] += self.coefficients.grad[p]

    def adjoint(self, s: int, count: int) -> None:
        """``stress_bar`` after the effect -> before it, from ``before`` as ``apply`` left it."""
        self.load(s, count)
        runtime.adjoint(self.pointwise, count)
        self.store(count)


@ti.data_oriented
class HistoryKernels:
    """``function(tau, F, C, q, dt, known, c) -> (h, q)`` on particles, of each branch: as ``StressKernels``, with
    internal variables q of ``InternalVariables`` and the stress h of the branch, which is added to tau.

    The adjoint is of one branch at a time: Taichi's autodiff takes a minute to compile that of three at once.
    """

    def __init__(self, mpm, function, internal):
        self.mpm = mpm
        self.function = function
        self.internal = internal
        self.n = internal.coefficients
        particles, real = mpm.capacity_particles, mpm.real
        self.total = ti.Vector.field(self.n, real, shape=(particles, internal.branches))
        self.before = ti.Matrix.field(3, 3, real, shape=particles, needs_grad=True)
        self.added = ti.Matrix.field(3, 3, real, shape=particles, needs_grad=True)
        self.gradient = ti.Matrix.field(3, 3, real, shape=particles, needs_grad=True)
        self.affine = ti.Matrix.field(3, 3, real, shape=particles, needs_grad=True)
        self.coefficients = ti.Vector.field(self.n, real, shape=particles, needs_grad=True)
        self.q_before = ti.Vector.field(internal.size, real, shape=particles, needs_grad=True)
        self.q_after = ti.Vector.field(internal.size, real, shape=particles, needs_grad=True)

    def write(self, values) -> None:
        """values (N, K), branch after branch; the sums of their gradients and the adjoint of internal variables after
        the last substep start at zero."""
        self.internal.write_coefficients(values)
        self.internal.clear_bar(len(values))
        self.clear_total(len(values))

    @ti.kernel
    def clear_total(self, count: ti.i32):
        for p, b in ti.ndrange(count, self.internal.branches):
            self.total[p, b] = ti.Vector.zero(self.mpm.real, self.n)

    @ti.kernel
    def read_gradient(self, out: ti.types.ndarray()):
        """out (N, K)."""
        for p in range(out.shape[0]):
            for b in range(self.internal.branches):
                for i in ti.static(range(self.n)):
                    out[p, b * self.n + i] = self.total[p, b][i]

    @ti.kernel
    def apply(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            tau = self.mpm.kirchhoff_stress[s, p]
            self.before[p] = tau
            for b in range(self.internal.branches):
                h, _ = self.function(
                    tau, self.mpm.deformation_gradient[s, p], self.mpm.affine_velocity[s, p],
                    self.internal.values[s, p, b], self.mpm.constants[DT], self.internal.known(s),
                    self.internal.c[p, b],
                )  # fmt: skip
                self.mpm.kirchhoff_stress[s, p] += h

    @ti.kernel
    def load(self, s: ti.i32, count: ti.i32):
        zero = ti.Matrix.zero(self.mpm.real, 3, 3)
        for p in range(count):
            self.gradient[p] = self.mpm.deformation_gradient[s, p]
            self.affine[p] = self.mpm.affine_velocity[s, p]
            self.before.grad[p] = zero
            self.gradient.grad[p] = zero
            self.affine.grad[p] = zero

    @ti.kernel
    def load_branch(self, s: ti.i32, b: ti.i32, count: ti.i32):
        for p in range(count):
            self.coefficients[p] = self.internal.c[p, b]
            self.q_before[p] = self.internal.values[s, p, b]
            self.added.grad[p] = self.mpm.stress_bar[p]
            self.q_after.grad[p] = self.internal.bar[p, b]
            self.coefficients.grad[p] = ti.Vector.zero(self.mpm.real, self.n)
            self.q_before.grad[p] = ti.Vector.zero(self.mpm.real, self.internal.size)

    @ti.kernel
    def pointwise(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            h, q = self.function(
                self.before[p], self.gradient[p], self.affine[p], self.q_before[p],
                self.mpm.constants[DT], self.internal.known(s), self.coefficients[p],
            )  # fmt: skip
            self.added[p] = h
            self.q_after[p] = q

    @ti.kernel
    def store_branch(self, b: ti.i32, count: ti.i32):
        for p in range(count):
            self.internal.bar[p, b] = self.q_before.grad[p]
            self.total[p, b] += self.coefficients.grad[p]

    @ti.kernel
    def store(self, count: ti.i32):
        for p in range(count):
            self.mpm.stress_bar[p] += self.before.grad[p]
            self.mpm.gradient_bar[p] += self.gradient.grad[p]
            self.mpm.affine_bar[p] += self.affine.grad[p]

    def adjoint(self, s: int, count: int) -> None:
        """``stress_bar`` and ``InternalVariables.bar`` after the effect -> before it, from ``before`` as ``apply`` left
        it."""
        self.load(s, count)
        for b in range(self.internal.branches):
            self.load_branch(s, b, count)
            runtime.adjoint(self.pointwise, s, count)
            self.store_branch(b, count)
        self.store(count)
