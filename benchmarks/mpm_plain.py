"""What the simulator is compared with: the same substep as one would first write it in Taichi. Atomic ``+=`` into one
grid, unrolled stencils, neo-Hookean stress in the P2G, gradients by ``kernel.grad()`` on every kernel."""

import taichi as ti

from masiv.kernels.tensor import identity3


@ti.data_oriented
class PlainMpm:
    """Neo-Hookean MLS-MPM over a fixed grid of ``cells``^3 nodes, sticky ground in the lowest layers."""

    def __init__(self, count, steps, cells, dx, dt, mass, volume, mu, lam):
        self.count, self.steps, self.cells, self.dx, self.dt = count, steps, cells, dx, dt
        self.mass, self.volume, self.mu, self.lam = mass, volume, mu, lam
        kept = dict(shape=(steps + 1, count), needs_grad=True)
        self.x = ti.Vector.field(3, ti.f32, **kept)
        self.v = ti.Vector.field(3, ti.f32, **kept)
        self.c = ti.Matrix.field(3, 3, ti.f32, **kept)
        self.f = ti.Matrix.field(3, 3, ti.f32, **kept)
        nodes = dict(shape=(cells, cells, cells), needs_grad=True)
        self.grid_p = ti.Vector.field(3, ti.f32, **nodes)
        self.grid_m = ti.field(ti.f32, **nodes)
        self.grid_v = ti.Vector.field(3, ti.f32, **nodes)
        self.loss = ti.field(ti.f32, shape=(), needs_grad=True)

    @ti.kernel
    def clear(self):
        for i in ti.grouped(self.grid_m):
            self.grid_p[i] = ti.Vector.zero(ti.f32, 3)
            self.grid_m[i] = 0.0
            self.grid_p.grad[i] = ti.Vector.zero(ti.f32, 3)
            self.grid_m.grad[i] = 0.0
            self.grid_v.grad[i] = ti.Vector.zero(ti.f32, 3)

    @ti.kernel
    def p2g(self, s: ti.i32):
        for p in range(self.count):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            fx = self.x[s, p] / self.dx - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            f = self.f[s, p]
            tau = self.mu * (f @ f.transpose() - identity3()) + self.lam * ti.log(f.determinant()) * identity3()
            affine = self.mass * self.c[s, p] - (self.dt * self.volume * 4 / self.dx**2) * tau
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                d = (ti.Vector([i, j, k]) - fx) * self.dx
                weight = w[i][0] * w[j][1] * w[k][2]
                self.grid_p[base + ti.Vector([i, j, k])] += weight * (self.mass * self.v[s, p] + affine @ d)
                self.grid_m[base + ti.Vector([i, j, k])] += weight * self.mass

    @ti.kernel
    def grid(self):
        for i in ti.grouped(self.grid_m):
            if self.grid_m[i] > 0:
                v = self.grid_p[i] / self.grid_m[i] + self.dt * ti.Vector([0.0, -9.8, 0.0])
                if i[1] < 3:
                    v = ti.Vector([0.0, 0.0, 0.0])
                self.grid_v[i] = v

    @ti.kernel
    def g2p(self, s: ti.i32):
        for p in range(self.count):
            base = ti.cast(self.x[s, p] / self.dx - 0.5, ti.i32)
            fx = self.x[s, p] / self.dx - base
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, 3)
            c = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                d = (ti.Vector([i, j, k]) - fx) * self.dx
                wv = w[i][0] * w[j][1] * w[k][2] * self.grid_v[base + ti.Vector([i, j, k])]
                v += wv
                c += (4 / self.dx**2) * wv.outer_product(d)
            self.v[s + 1, p] = v
            self.c[s + 1, p] = c
            self.x[s + 1, p] = self.x[s, p] + self.dt * v
            self.f[s + 1, p] = (identity3() + self.dt * c) @ self.f[s, p]

    @ti.kernel
    def measure(self, s: ti.i32):
        for p in range(self.count):
            self.loss[None] += self.x[s, p].norm_sqr()

    def forward(self):
        for s in range(self.steps):
            self.clear()
            self.p2g(s)
            self.grid()
            self.g2p(s)

    def backward(self):
        self.loss.grad[None] = 1.0
        self.measure.grad(self.steps)
        for s in reversed(range(self.steps)):
            self.clear()
            self.p2g(s)
            self.grid()
            self.g2p.grad(s)
            self.grid.grad()
            self.p2g.grad(s)
