"""A substep in one launch.

On a CPU a launch costs about as much as the transfer of 1500 particles to the grid. So a whole substep is one launch,
and several substeps are one if they run on one thread. On a GPU it is one launch of four loops, each over all
particles or nodes.
"""

import taichi as ti

from masiv.kernels.grid import DT, two_floats


@ti.data_oriented
class SubstepKernels:
    """law: kernels with Taichi functions ``flow_particle(s, p)``, trial gradient -> elastic gradient, and
    ``stress_particle(s, p)``, from there to the stress. effects: ``NoEffects`` or ``ForwardEffects``. serial:
    ``advance`` runs on one thread; the results differ in rounding only."""

    def __init__(self, mpm, law, effects, serial: bool):
        self.mpm = mpm
        self.law = law
        self.effects = effects
        self.serial = serial

    @ti.func
    def to_grid(self, t: ti.i32, s: ti.i32, count: ti.i32, nodes: ti.i32):
        """Law, effects on the stress, and P2G of chunk t of the particles."""
        for n in range(nodes):
            self.mpm.partial_grids[t, n] = ti.Vector.zero(self.mpm.real, 4)
        # Two loops: what a particle computes is one long chain, and a core works at several short ones at once.
        for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
            self.law.flow_particle(s, p)
        for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
            self.law.stress_particle(s, p)
            self.effects.on_stress_of(s, p)
            self.mpm.p2g_particle(t, s, p)

    @ti.func
    def on_grid(self, t: ti.i32, s: ti.i32, begin: ti.i32, nodes: ti.i32, log: ti.i32, time):
        """Chunk t of the rows; their momenta are kept if the log has room, else they go to its scratch at 0."""
        place = log + (s - begin) * nodes
        offset = ti.select(place + nodes <= self.mpm.capacity_log, place, 0)
        rows = self.mpm.rows()
        for row in range(t * rows // self.mpm.chunks, (t + 1) * rows // self.mpm.chunks):
            self.effects.row_update(row, offset, time)

    @ti.func
    def to_particle(self, s: ti.i32, p: ti.i32):
        """G2P and forces of particle p."""
        self.mpm.g2p_particle(s, p)
        self.effects.on_velocity_of(s + 1, p)

    @ti.func
    def particle_to_grid(self, s: ti.i32, p: ti.i32):
        self.law.flow_particle(s, p)
        self.law.stress_particle(s, p)
        self.effects.on_stress_of(s, p)
        self.mpm.p2g_particle(0, s, p)

    @ti.kernel
    def transfer(self, s: ti.i32, count: ti.i32, nodes: ti.i32):
        """Law, effects on the stress, and P2G."""
        if ti.static(self.mpm.gpu):
            for n in range(nodes):
                self.mpm.partial_grids[0, n] = ti.Vector.zero(self.mpm.real, 4)
            for p in range(count):
                self.particle_to_grid(s, p)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                self.to_grid(t, s, count, nodes)

    @ti.kernel
    def on_cpu(self, begin: ti.i32, end: ti.i32, count: ti.i32, nodes: ti.i32, log: ti.i32, time: ti.f64):
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for s in range(begin, end):
                now = time + (s - begin) * ti.cast(self.mpm.constants[DT], ti.f64)
                for t in range(self.mpm.chunks):
                    self.to_grid(t, s, count, nodes)
                for t in range(self.mpm.chunks):
                    self.on_grid(t, s, begin, nodes, log, now)
                for p in range(count):
                    self.to_particle(s, p)
                self.effects.on_suspended(s + 1, count)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                self.to_grid(t, begin, count, nodes)
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                self.on_grid(t, begin, begin, nodes, log, time)
            for p in range(count):
                self.to_particle(begin, p)

    @ti.kernel
    def on_gpu(self, s: ti.i32, count: ti.i32, nodes: ti.i32, log: ti.i32, time: ti.f32, time_rest: ti.f32):
        for n in range(nodes):
            self.mpm.partial_grids[0, n] = ti.Vector.zero(self.mpm.real, 4)
        for p in range(count):
            self.particle_to_grid(s, p)
        for n in range(nodes):
            self.effects.node_update(n, log, self.mpm.sum_of_two(time, time_rest))
        for p in range(count):
            self.to_particle(s, p)
        if ti.static(self.effects.suspends):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.effects.on_suspended(s + 1, count)

    def advance(self, begin: int, end: int, count: int, nodes: int, log: int, time: float) -> None:
        """Substeps begin … end - 1, a single one if not ``serial``; log: first entry of the grid of ``begin``; time [s]
        at its start."""
        if self.mpm.gpu:
            place = log if log + nodes <= self.mpm.capacity_log else 0
            self.on_gpu(begin, count, nodes, place, *two_floats(time))
        else:
            self.on_cpu(begin, end, count, nodes, log, time)
