"""Parts of a substep in one launch, on a CPU.

A launch costs about as much as the transfer of 1500 particles to the grid. So a whole substep without effects is one
launch, and several substeps are one if they run on one thread. With effects, only the grid's update is specialised: a
kernel of the whole substep for each set of effects would take seconds to compile.
"""

import taichi as ti


@ti.data_oriented
class SubstepKernels:
    """law: kernels with Taichi functions ``flow_particle(s, p)``, trial gradient -> elastic gradient, and
    ``stress_particle(s, p)``, from there to the stress. serial: ``advance`` runs on one thread; the results differ in
    rounding only."""

    def __init__(self, mpm, law, serial: bool):
        self.mpm = mpm
        self.law = law
        self.serial = serial

    @ti.func
    def to_grid(self, t: ti.i32, s: ti.i32, count: ti.i32, nodes: ti.i32):
        """Law and P2G of chunk t of the particles."""
        for n in range(nodes):
            self.mpm.partial_grids[t, n] = ti.Vector.zero(self.mpm.real, 4)
        # Two loops: what a particle computes is one long chain, and a core works at several short ones at once.
        for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
            self.law.flow_particle(s, p)
        for p in range(t * count // self.mpm.chunks, (t + 1) * count // self.mpm.chunks):
            self.law.stress_particle(s, p)
            self.mpm.p2g_particle(t, s, p)

    @ti.func
    def on_grid(self, t: ti.i32, s: ti.i32, begin: ti.i32, nodes: ti.i32, log: ti.i32):
        """Chunk t of the rows; their momenta are kept if the log has room, else they go to its scratch at 0."""
        place = log + (s - begin) * nodes
        offset = ti.select(place + nodes <= self.mpm.capacity_log, place, 0)
        rows = self.mpm.rows()
        for row in range(t * rows // self.mpm.chunks, (t + 1) * rows // self.mpm.chunks):
            self.mpm.row_update(row, offset)

    @ti.kernel
    def transfer(self, s: ti.i32, count: ti.i32, nodes: ti.i32):
        """Law and P2G."""
        ti.loop_config(block_dim=1)
        for t in range(self.mpm.chunks):
            self.to_grid(t, s, count, nodes)

    @ti.kernel
    def advance(self, begin: ti.i32, end: ti.i32, count: ti.i32, nodes: ti.i32, log: ti.i32):
        """Substeps begin … end - 1, a single one if not ``serial``; log: first entry of the grid of ``begin``."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for s in range(begin, end):
                for t in range(self.mpm.chunks):
                    self.to_grid(t, s, count, nodes)
                for t in range(self.mpm.chunks):
                    self.on_grid(t, s, begin, nodes, log)
                for p in range(count):
                    self.mpm.g2p_particle(s, p)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                self.to_grid(t, begin, count, nodes)
            ti.loop_config(block_dim=1)
            for t in range(self.mpm.chunks):
                self.on_grid(t, begin, begin, nodes, log)
            for p in range(count):
                self.mpm.g2p_particle(begin, p)
