"""Effects in a forward substep: switched on and off when it runs, so that one kernel serves every set of them."""

import taichi as ti

from masiv.kernels.grid import DT, DX, FRICTION, NO_GROUND, contact_velocity, momentum_of, two_floats


@ti.data_oriented
class NoEffects:
    """The interface of ``ForwardEffects`` where nothing acts."""

    suspends = False

    def __init__(self, mpm):
        self.mpm = mpm

    @ti.func
    def row_update(self, row: ti.i32, offset: ti.i32, now):
        self.mpm.row_update(row, offset)

    @ti.func
    def node_update(self, n: ti.i32, offset: ti.i32, now):
        self.mpm.node_update(n, offset)

    @ti.func
    def on_stress_of(self, s: ti.i32, p: ti.i32):
        pass

    @ti.func
    def on_velocity_of(self, s: ti.i32, p: ti.i32):
        pass

    @ti.func
    def on_suspended(self, s: ti.i32, count: ti.i32):
        pass


def no_effects(mpm):
    """The ``NoEffects`` of ``mpm``."""
    return mpm.attached(NoEffects, lambda: NoEffects(mpm))


@ti.data_oriented
class ForwardEffects:
    """Functions of effects (``masiv.effects.effect``), each with its number of coefficients: on the nodes, on the nodes
    on or below the ground (of which one at most acts), on the stress, the latter with its ``InternalVariables`` or
    None; forces on the particles; and ``suspension`` (``SuspensionKernels``), a mass on a thread, or None.

    They act in this order. ``acting``: bit e is set if function e acts, the bit after the last if forces do.
    """

    def __init__(self, mpm, on_nodes, on_ground, on_stress, suspension=None):
        self.mpm = mpm
        self.suspension, self.suspends = suspension, suspension is not None
        self.functions = [e[0] for e in (*on_nodes, *on_ground, *on_stress)]
        self.sizes = [e[1] for e in (*on_nodes, *on_ground, *on_stress)]
        self.remembers = [e[2] is not None for e in on_stress]
        self.internal = next((e[2] for e in on_stress if e[2] is not None), None)
        self.nodal, self.grid = len(on_nodes), len(on_nodes) + len(on_ground)
        self.all = len(self.functions)
        assert self.all < 31, "bits of acting"
        self.starts = [sum(self.sizes[:e]) for e in range(self.grid)]
        self.values = ti.field(mpm.real, shape=max(sum(self.sizes[: self.grid]), 1))
        capacity = mpm.capacity_particles
        self.of_particles = [ti.Vector.field(n, mpm.real, shape=capacity) for n in self.sizes[self.grid :]]
        self.force = ti.Vector.field(3, mpm.real, shape=capacity)
        self.acting = ti.field(ti.i32, shape=())

    # ---- coefficients ------------------------------------------------------------------------------------------------

    def write(self, values, force) -> None:
        """values: by index of the function, coefficients of those that act: (K,), of those on the stress (N, K); force
        (N, 3) [N], None if none acts."""
        self.acting[None] = sum(1 << e for e in values) + (0 if force is None else 1 << self.all)
        for e, c in values.items():
            if e < self.grid:
                self.write_values(self.starts[e], c)
            elif self.remembers[e - self.grid]:
                self.internal.write_coefficients(c)
            else:
                self.write_of_particles(e - self.grid, c)
        if force is not None:
            self.write_force(force)

    @ti.kernel
    def write_values(self, start: ti.i32, values: ti.types.ndarray()):
        for i in range(values.shape[0]):
            self.values[start + i] = values[i]

    @ti.kernel
    def write_of_particles(self, which: ti.template(), values: ti.types.ndarray()):
        for p in range(values.shape[0]):
            for i in ti.static(range(self.sizes[self.grid + which])):
                self.of_particles[which][p][i] = values[p, i]

    @ti.kernel
    def write_force(self, values: ti.types.ndarray()):
        for p in range(values.shape[0]):
            for i in ti.static(range(3)):
                self.force[p][i] = values[p, i]

    # ---- what acts on a row of nodes, on a particle ------------------------------------------------------------------

    @ti.func
    def coefficients(self, e: ti.template()):
        c = ti.Vector.zero(self.mpm.real, self.sizes[e])
        for i in ti.static(range(self.sizes[e])):
            c[i] = self.values[self.starts[e] + i]
        return c

    @ti.func
    def node_update(self, n: ti.i32, offset: ti.i32, now):
        """``MpmKernels.node_update`` with effects between gravity and contact; now [s]."""
        self.update(n, offset, ti.cast(now, self.mpm.real), self.acting[None], self.mpm.grounded(n))

    @ti.func
    def update(self, n: ti.i32, offset: ti.i32, now, acting: ti.i32, grounded):
        dt, dx = self.mpm.constants[DT], self.mpm.constants[DX]
        value = self.mpm.sum_of_chunks(n)
        self.mpm.grid_momentum[offset + n] = value
        v = ti.Vector.zero(self.mpm.real, 3)
        if value[3] > 0.0:
            v = momentum_of(value) / value[3] + dt * self.mpm.gravity()
            x = self.mpm.node_position(n)
            for e in ti.static(range(self.nodal)):
                if acting & (1 << e):
                    v = self.functions[e](x, v, now, dt, dx, self.coefficients(e))
            if grounded:
                held = contact_velocity(v, self.mpm.contact[None], self.mpm.constants[FRICTION])
                after = held
                for e in ti.static(range(self.nodal, self.grid)):
                    if acting & (1 << e):
                        after = self.functions[e](x, v, held, now, dt, dx, self.coefficients(e))
                v = after
        self.mpm.grid_velocity[n] = ti.Vector([v[0], v[1], v[2], 0.0])

    @ti.func
    def row_update(self, row: ti.i32, offset: ti.i32, t):
        """``node_update`` of a row's nodes, t [s]."""
        nz, acting, now = self.mpm.window_shape[None][2], self.acting[None], ti.cast(t, self.mpm.real)
        grounded = self.mpm.contact[None] != NO_GROUND and self.mpm.node_height(row) <= 0
        for n in range(row * nz, (row + 1) * nz):
            self.update(n, offset, now, acting, grounded)

    @ti.func
    def on_stress_of(self, s: ti.i32, p: ti.i32):
        for e in ti.static(range(self.grid, self.all)):
            if self.acting[None] & (1 << e):
                tau, f = self.mpm.kirchhoff_stress[s, p], self.mpm.deformation_gradient[s, p]
                affine = self.mpm.affine_velocity[s, p]
                if ti.static(self.remembers[e - self.grid]):
                    for b in range(self.internal.branches):
                        h, q = self.functions[e](
                            tau, f, affine, self.internal.values[s, p, b], self.mpm.constants[DT],
                            self.internal.known(s), self.internal.c[p, b],
                        )  # fmt: skip
                        self.mpm.kirchhoff_stress[s, p] += h
                        self.internal.values[s + 1, p, b] = q
                else:
                    self.mpm.kirchhoff_stress[s, p] = self.functions[e](
                        tau, f, affine, self.of_particles[e - self.grid][p]
                    )

    @ti.func
    def on_velocity_of(self, s: ti.i32, p: ti.i32):
        """Forces act on the velocities at the start of substep s, which G2P of the one before has written."""
        if self.acting[None] & (1 << self.all):
            self.mpm.velocity[s, p] += (self.mpm.constants[DT] / self.mpm.particle_mass[p]) * self.force[p]

    @ti.func
    def on_suspended(self, s: ti.i32, count: ti.i32):
        """The mass on the thread, after the forces on all particles."""
        if ti.static(self.suspends):
            self.suspension.advance(s, count)

    # ---- for a substep in several launches ---------------------------------------------------------------------------

    @ti.kernel
    def grid_update_at(self, offset: ti.i32, nodes: ti.i32, t: ti.f32, t_rest: ti.f32):
        if ti.static(self.mpm.gpu):
            for n in range(nodes):
                self.node_update(n, offset, self.mpm.sum_of_two(t, t_rest))
        else:
            ti.loop_config(block_dim=1)
            for part in range(self.mpm.chunks):
                rows = self.mpm.rows()
                for row in range(part * rows // self.mpm.chunks, (part + 1) * rows // self.mpm.chunks):
                    self.row_update(row, offset, self.mpm.sum_of_two(t, t_rest))

    def grid_update(self, offset: int, nodes: int, t: float) -> None:
        """The nodes' velocities from the log at ``offset``; t [s]."""
        self.grid_update_at(offset, nodes, *two_floats(t))

    @ti.kernel
    def on_stress(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.on_stress_of(s, p)

    @ti.kernel
    def on_velocities(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.on_velocity_of(s, p)
