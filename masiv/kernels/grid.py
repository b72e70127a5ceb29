"""The grid of MLS-MPM: a window that follows the particles, its velocities after gravity and contact; their adjoint.

Node (i, j, k) of the lattice dx Z^3 lives at a flat index relative to ``window_origin``, so the domain is unbounded and
memory is that of the object. On a CPU each chunk of particles scatters into a grid of its own (a float atomic is a
compare-and-swap loop there, and its order is not reproducible); on a GPU all particles scatter into one, atomically.
"""

import ctypes

import taichi as ti

STICKY, RELEASE, SLIP, NO_GROUND = 0, 1, 2, 3

# Entries of ``constants``.
DT, DX, VOLUME, GRAVITY_X, GRAVITY_Y, GRAVITY_Z, FRICTION, CONSTANT_COUNT = range(8)


@ti.func
def momentum_of(value):
    """The first three of four."""
    return ti.Vector([value[0], value[1], value[2]])


def two_floats(t: float) -> tuple[float, float]:
    """t as the sum of two float32, for the arguments of kernels: Vulkan devices may lack float64."""
    high = ctypes.c_float(t).value
    return high, t - high


@ti.func
def contact_velocity(v, contact: ti.i32, friction):
    """Velocity of a node on or below the ground after contact. Friction is Coulomb's, for ``SLIP``."""
    out = v
    if contact == STICKY:
        out = 0.0 * v
    elif v[1] < 0.0:
        if contact == RELEASE:
            out = 0.0 * v
        else:
            tangent = ti.Vector([v[0], 0.0, v[2]])
            speed = ti.sqrt(v[0] * v[0] + v[2] * v[2])
            kept = 0.0 * speed
            if speed > -friction * v[1]:
                kept = 1.0 + friction * v[1] / speed
            out = kept * tangent
    return out


@ti.func
def contact_adjoint(v, bar, contact: ti.i32, friction):
    """Adjoint of ``contact_velocity`` at v."""
    out = bar
    if contact == STICKY:
        out = 0.0 * v
    elif v[1] < 0.0:
        out = 0.0 * v
        if contact == SLIP:
            mu = friction
            speed = ti.sqrt(v[0] * v[0] + v[2] * v[2])
            if speed > -mu * v[1]:
                along = (bar[0] * v[0] + bar[2] * v[2]) / speed
                kept = 1.0 + mu * v[1] / speed
                turn = -mu * v[1] * along / (speed * speed)
                out = ti.Vector([kept * bar[0] + turn * v[0], mu * along, kept * bar[2] + turn * v[2]])
    return out


@ti.data_oriented
class GridKernels:
    """Memory and kernels of the nodes. Simulation frame (y up, ground at y = 0), SI units.

    capacity_nodes: upper bound; capacity_log: entries of the log of past substeps' nodes.
    """

    def __init__(self, real, capacity_nodes: int, capacity_log: int, chunks: int, gpu: bool):
        self.real = real
        self.capacity_nodes = capacity_nodes
        self.capacity_log = capacity_log
        self.gpu = gpu
        self.chunks = 1 if gpu else chunks
        self.partial_grids = ti.Vector.field(4, real, shape=(self.chunks, capacity_nodes))
        # (momentum, mass) of the nodes: scratch, then a log from which the adjoint takes the grids of past substeps.
        self.grid_momentum = ti.Vector.field(4, real, shape=capacity_log)
        self.grid_velocity = ti.Vector.field(4, real, shape=capacity_nodes)  # the fourth pads: one aligned load
        self.grid_velocity_bar = ti.Vector.field(3, real, shape=capacity_nodes)
        self.grid_momentum_bar = ti.Vector.field(4, real, shape=capacity_nodes)
        self.constants = ti.field(real, shape=CONSTANT_COUNT)
        self.contact = ti.field(ti.i32, shape=())
        self.window_origin = ti.Vector.field(3, ti.i32, shape=())
        self.window_shape = ti.Vector.field(3, ti.i32, shape=())

    @ti.func
    def weights(self, fx):
        """Rows: the three nodes; columns: axes. Quadratic B-spline."""
        w = ti.Matrix.zero(self.real, 3, 3)
        for a in ti.static(range(3)):
            w[0, a] = 0.5 * (1.5 - fx[a]) * (1.5 - fx[a])
            w[1, a] = 0.75 - (fx[a] - 1.0) * (fx[a] - 1.0)
            w[2, a] = 0.5 * (fx[a] - 0.5) * (fx[a] - 0.5)
        return w

    @ti.func
    def weight_gradients(self, fx):
        """Derivative of ``weights`` with respect to fx."""
        g = ti.Matrix.zero(self.real, 3, 3)
        for a in ti.static(range(3)):
            g[0, a] = fx[a] - 1.5
            g[1, a] = -2.0 * (fx[a] - 1.0)
            g[2, a] = fx[a] - 0.5
        return g

    @ti.func
    def stencil(self, x, dx):
        """Base node relative to the window, offset of the particle from it in cells, and whether the stencil fits."""
        scaled = x / dx
        base = ti.floor(scaled - 0.5, ti.i32)
        fx = scaled - base
        local = base - self.window_origin[None]
        fits = True
        for a in ti.static(range(3)):
            if local[a] < 0 or local[a] + 2 >= self.window_shape[None][a]:
                fits = False
        return local, fx, fits

    @ti.func
    def sum_of_two(self, high: ti.f32, low: ti.f32):
        """What ``two_floats`` took apart."""
        return ti.cast(high, self.real) + ti.cast(low, self.real)

    @ti.func
    def add(self, t: ti.i32, node: ti.i32, value):
        if ti.static(self.gpu):
            self.partial_grids[t, node] += value
        else:
            self.partial_grids[t, node] = self.partial_grids[t, node] + value

    @ti.func
    def node_height(self, row: ti.i32):
        """Lattice index along y of a row of nodes (all k of one i, j); the ground plane is at 0."""
        return self.window_origin[None][1] + row % self.window_shape[None][1]

    @ti.func
    def node_position(self, n: ti.i32):
        """Place [m] of the node with flat index n."""
        shape, origin, dx = self.window_shape[None], self.window_origin[None], self.constants[DX]
        k = n % shape[2]
        j = (n // shape[2]) % shape[1]
        i = n // (shape[2] * shape[1])
        return ti.Vector([(origin[0] + i) * dx, (origin[1] + j) * dx, (origin[2] + k) * dx])

    @ti.func
    def grounded(self, n: ti.i32):
        """Whether node n touches the ground."""
        return self.contact[None] != NO_GROUND and self.node_height(n // self.window_shape[None][2]) <= 0

    @ti.func
    def rows(self):
        return self.window_shape[None][0] * self.window_shape[None][1]

    @ti.func
    def gravity(self):
        return ti.Vector([self.constants[GRAVITY_X], self.constants[GRAVITY_Y], self.constants[GRAVITY_Z]])

    @ti.func
    def sum_of_chunks(self, n: ti.i32):
        value = self.partial_grids[0, n]
        for t in ti.static(range(1, self.chunks)):
            value += self.partial_grids[t, n]
        return value

    @ti.func
    def node_velocity(self, n: ti.i32, offset: ti.i32, kick, grounded):
        """Velocity of node n after gravity and contact, from its momentum in the log at ``offset``."""
        value = self.grid_momentum[offset + n]
        v = ti.Vector.zero(self.real, 3)
        if value[3] > 0.0:
            v = momentum_of(value) / value[3] + kick
            if grounded:
                v = contact_velocity(v, self.contact[None], self.constants[FRICTION])
        self.grid_velocity[n] = ti.Vector([v[0], v[1], v[2], 0.0])

    @ti.func
    def row_velocities(self, row: ti.i32, offset: ti.i32):
        """``node_velocity`` of a row's nodes."""
        nz = self.window_shape[None][2]
        kick = self.constants[DT] * self.gravity()
        grounded = self.contact[None] != NO_GROUND and self.node_height(row) <= 0
        for n in range(row * nz, (row + 1) * nz):
            self.node_velocity(n, offset, kick, grounded)

    @ti.func
    def node_update(self, n: ti.i32, offset: ti.i32):
        """Node n on a GPU, as ``row_update`` is of a row on a CPU."""
        self.grid_momentum[offset + n] = self.sum_of_chunks(n)
        self.node_velocity(n, offset, self.constants[DT] * self.gravity(), self.grounded(n))

    @ti.func
    def row_update(self, row: ti.i32, offset: ti.i32):
        nz = self.window_shape[None][2]
        for n in range(row * nz, (row + 1) * nz):
            self.grid_momentum[offset + n] = self.sum_of_chunks(n)
        self.row_velocities(row, offset)

    @ti.kernel
    def grid_update(self, offset: ti.i32, nodes: ti.i32):
        """Sum the chunks' grids into the log at ``offset``, and the velocities that follow."""
        if ti.static(self.gpu):
            for n in range(nodes):
                self.node_update(n, offset)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.chunks):
                for row in range(t * self.rows() // self.chunks, (t + 1) * self.rows() // self.chunks):
                    self.row_update(row, offset)

    @ti.kernel
    def grid_velocities(self, offset: ti.i32, nodes: ti.i32):
        """``grid_update`` from a logged grid."""
        if ti.static(self.gpu):
            for n in range(nodes):
                self.node_velocity(n, offset, self.constants[DT] * self.gravity(), self.grounded(n))
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.chunks):
                for row in range(t * self.rows() // self.chunks, (t + 1) * self.rows() // self.chunks):
                    self.row_velocities(row, offset)

    @ti.func
    def node_adjoint(self, n: ti.i32, offset: ti.i32, kick, grounded):
        out = ti.Vector.zero(self.real, 4)
        value = self.grid_momentum[offset + n]
        if value[3] > 0.0:
            bar = momentum_of(self.sum_of_chunks(n))
            momentum = momentum_of(value)
            if grounded:
                bar = contact_adjoint(momentum / value[3] + kick, bar, self.contact[None], self.constants[FRICTION])
            out = ti.Vector([bar[0], bar[1], bar[2], -bar.dot(momentum) / value[3]]) / value[3]
        self.grid_momentum_bar[n] = out

    @ti.func
    def row_adjoint(self, row: ti.i32, offset: ti.i32):
        nz = self.window_shape[None][2]
        kick = self.constants[DT] * self.gravity()
        grounded = self.contact[None] != NO_GROUND and self.node_height(row) <= 0
        for n in range(row * nz, (row + 1) * nz):
            self.node_adjoint(n, offset, kick, grounded)

    @ti.kernel
    def grid_adjoint(self, offset: ti.i32, nodes: ti.i32):
        if ti.static(self.gpu):
            for n in range(nodes):
                self.node_adjoint(n, offset, self.constants[DT] * self.gravity(), self.grounded(n))
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.chunks):
                for row in range(t * self.rows() // self.chunks, (t + 1) * self.rows() // self.chunks):
                    self.row_adjoint(row, offset)
