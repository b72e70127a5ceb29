"""One substep of MLS-MPM (APIC, quadratic B-splines) and its hand-written adjoint, on preallocated fields.

Forward (Hu et al. 2018, "A moving least squares material point method"):

    p2g   partial_grids[t, i] += w_ip (m v_p + A_p d_ip, m),  A_p = m C_p - dt V 4/dx^2 tau_p,  d_ip = x_i - x_p
    grid  v_i = momentum_i / m_i + dt g, then contact with the ground plane y = 0
    g2p   v_p = sum w v_i,  C_p = 4/dx^2 sum w v_i d^T,  x_p += dt v_p,  F_trial = (I + dt C_p) F

The adjoint of P2G is a gather and the adjoint of G2P a scatter, so both directions share two loop shapes. The grid is
in ``masiv.kernels.grid``. State fields are allocated by capacity, and live counts are kernel arguments: a field's shape
is part of a compiled kernel.
"""

from collections.abc import Callable, Hashable
from typing import Any

import taichi as ti
import torch

from masiv.kernels.grid import DT, DX, VOLUME, GridKernels, momentum_of

TOO_FAST, OUTSIDE = 0, 1
"""Errors of a particle: it is not finite or crosses more than a cell in a substep; it left the window."""
NO_ERROR = (1 << 31) - 1


def log_entries_a_substep(particles: int) -> int:
    """Nodes of the log that are reserved for the grid of one substep; larger windows fill it with fewer substeps."""
    return max(4096, particles)


@ti.func
def column(a, c: ti.template()):
    return ti.Vector([a[0, c], a[1, c], a[2, c]])


@ti.func
def by_columns(a, b, c):
    """The matrix of three columns, of which the first three entries count."""
    return ti.Matrix([[a[0], b[0], c[0]], [a[1], b[1], c[1]], [a[2], b[2], c[2]]])


@ti.data_oriented
class MpmKernels(GridKernels):
    """Memory and kernels. Positions in the simulation frame (y up, ground at y = 0), SI units.

    capacity_steps: substeps whose state is kept at once; capacity_particles, capacity_nodes: upper bounds.
    """

    def __init__(self, real, capacity_steps: int, capacity_particles: int, capacity_nodes: int, chunks: int, gpu: bool):
        capacity_log = capacity_nodes + capacity_steps * log_entries_a_substep(capacity_particles)
        super().__init__(real, capacity_nodes, capacity_log, chunks, gpu)
        self.capacity_steps = capacity_steps
        self.capacity_particles = capacity_particles
        self.torch_dtype = torch.float64 if real == ti.f64 else torch.float32
        self.owner: object = None  # the rollout whose states the fields hold
        self._attached: dict[Hashable, Any] = {}
        # Threads of a GPU read one entry of neighbouring particles at a time, a core all entries of one particle.
        stored: dict[str, Any] = {
            "shape": (capacity_steps + 1, capacity_particles), "layout": ti.Layout.SOA if gpu else ti.Layout.AOS,
        }  # fmt: skip
        self.position = ti.Vector.field(3, real, **stored)
        self.velocity = ti.Vector.field(3, real, **stored)
        self.affine_velocity = ti.Matrix.field(3, 3, real, **stored)
        self.trial_gradient = ti.Matrix.field(3, 3, real, **stored)
        self.deformation_gradient = ti.Matrix.field(3, 3, real, **stored)
        self.kirchhoff_stress = ti.Matrix.field(3, 3, real, **stored)
        self.position_bar = ti.Vector.field(3, real, shape=capacity_particles)
        self.velocity_bar = ti.Vector.field(3, real, shape=capacity_particles)
        self.affine_bar = ti.Matrix.field(3, 3, real, shape=capacity_particles)
        self.trial_bar = ti.Matrix.field(3, 3, real, shape=capacity_particles)
        self.gradient_bar = ti.Matrix.field(3, 3, real, shape=capacity_particles)
        self.stress_bar = ti.Matrix.field(3, 3, real, shape=capacity_particles)
        self.particle_mass = ti.field(real, shape=capacity_particles)
        self.mass_bar = ti.field(real, shape=capacity_particles)
        # First substep with an error of each kind, and the first particle in it. Vulkan has no 64-bit atomics.
        self.error_substep = ti.field(ti.i32, shape=2)
        self.error_particle = ti.field(ti.i32, shape=2)

    def attached(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Kernels with fields of their own for these fields, made once for each ``key``.

        They live as long as these: Taichi frees no field before the process ends.
        """
        if key not in self._attached:
            self._attached[key] = make()
        return self._attached[key]

    def allocate(self) -> None:
        """Allocate all fields that were declared, which the next launch of a kernel would do."""
        ti.sync()

    # ---- forward -----------------------------------------------------------------------------------------------------

    @ti.func
    def report(self, kind: ti.template(), s: ti.i32, p: ti.i32):
        """An error of particle p in substep s. All of a substep are reported before one of the next."""
        if s <= self.error_substep[kind]:
            ti.atomic_min(self.error_substep[kind], s)
            ti.atomic_min(self.error_particle[kind], p)

    @ti.func
    def p2g_plane(self, t: ti.i32, i, local, w, corner, affine, mass):
        """The nine nodes of plane i of a stencil. An inner loop over planes compiles faster; in two tasks of one kernel
        Taichi 1.7.4 fails to translate it for Vulkan."""
        ny, nz = self.window_shape[None][1], self.window_shape[None][2]
        row = ((local[0] + i) * ny + local[1]) * nz + local[2]
        for j in ti.static(range(3)):
            along = corner + i * column(affine, 0) + j * column(affine, 1)
            weight = w[i, 0] * w[j, 1]
            for k in ti.static(range(3)):
                m = (weight * w[k, 2]) * (along + k * column(affine, 2))
                value = ti.Vector([m[0], m[1], m[2], weight * w[k, 2] * mass])
                self.add(t, row + j * nz + k, value)

    @ti.func
    def p2g_particle(self, t: ti.i32, s: ti.i32, p: ti.i32):
        dx, dt, mass = self.constants[DX], self.constants[DT], self.particle_mass[p]
        local, fx, fits = self.stencil(self.position[s, p], dx)
        if fits:
            w = self.weights(fx)
            affine = (
                mass * self.affine_velocity[s, p]
                - (dt * self.constants[VOLUME] * 4.0 / (dx * dx)) * self.kirchhoff_stress[s, p]
            )
            corner = mass * self.velocity[s, p] - affine @ (fx * dx)
            affine *= dx
            if ti.static(self.gpu):
                for i in ti.static(range(3)):
                    self.p2g_plane(t, i, local, w, corner, affine, mass)
            else:
                for i in range(3):
                    self.p2g_plane(t, i, local, w, corner, affine, mass)
        else:
            self.report(OUTSIDE, s, p)

    @ti.kernel
    def p2g(self, s: ti.i32, count: ti.i32, nodes: ti.i32):
        if ti.static(self.gpu):
            for n in range(nodes):
                self.partial_grids[0, n] = ti.Vector.zero(self.real, 4)
            for p in range(count):
                self.p2g_particle(0, s, p)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.chunks):
                for n in range(nodes):
                    self.partial_grids[t, n] = ti.Vector.zero(self.real, 4)
                for p in range(t * count // self.chunks, (t + 1) * count // self.chunks):
                    self.p2g_particle(t, s, p)

    @ti.func
    def g2p_particle(self, s: ti.i32, p: ti.i32):
        dx, dt = self.constants[DX], self.constants[DT]
        x = self.position[s, p]
        local, fx, fits = self.stencil(x, dx)
        if fits:
            ny, nz = self.window_shape[None][1], self.window_shape[None][2]
            w = self.weights(fx)
            v4 = ti.Vector.zero(self.real, 4)
            # sum w v_i (i, j, k)^T by columns, in cells from the stencil's corner
            b0, b1, b2 = ti.Vector.zero(self.real, 4), ti.Vector.zero(self.real, 4), ti.Vector.zero(self.real, 4)
            for i in range(3):
                row = ((local[0] + i) * ny + local[1]) * nz + local[2]
                plane = ti.Vector.zero(self.real, 4)
                for j in ti.static(range(3)):
                    first = w[0, 2] * self.grid_velocity[row + j * nz]
                    second = w[1, 2] * self.grid_velocity[row + j * nz + 1]
                    third = w[2, 2] * self.grid_velocity[row + j * nz + 2]
                    line = w[j, 1] * (first + second + third)
                    plane += line
                    b1 += (w[i, 0] * j) * line
                    b2 += (w[i, 0] * w[j, 1]) * (second + 2.0 * third)
                v4 += w[i, 0] * plane
                b0 += (w[i, 0] * i) * plane
            b = by_columns(b0, b1, b2)
            v = momentum_of(v4)
            affine = (4.0 / dx) * (b - v.outer_product(fx))
            if not v.norm() * dt < dx:  # also true for NaN
                self.report(TOO_FAST, s, p)
            self.velocity[s + 1, p] = v
            self.affine_velocity[s + 1, p] = affine
            self.position[s + 1, p] = x + dt * v
            f = self.deformation_gradient[s, p]
            self.trial_gradient[s + 1, p] = f + dt * (affine @ f)

    @ti.kernel
    def g2p(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.g2p_particle(s, p)

    @ti.func
    def box(self, s: ti.i32, count: ti.i32):
        out = ti.Vector([1e30, 1e30, 1e30, -1e30, -1e30, -1e30, 0.0], dt=self.real)
        parts = ti.static(1024 if self.gpu else self.chunks)
        ti.loop_config(block_dim=128 if self.gpu else 1)
        for t in range(parts):
            low, high = ti.Vector([1e30, 1e30, 1e30]), ti.Vector([-1e30, -1e30, -1e30])
            speed = ti.cast(0.0, self.real)
            for p in range(t * count // parts, (t + 1) * count // parts):
                low = ti.min(low, self.position[s, p])
                high = ti.max(high, self.position[s, p])
                speed = ti.max(speed, self.velocity[s, p].norm())
            for a in ti.static(range(3)):
                ti.atomic_min(out[a], ti.cast(low[a], self.real))
                ti.atomic_max(out[3 + a], ti.cast(high[a], self.real))
            ti.atomic_max(out[6], speed)
        return out

    @ti.kernel
    def box32(self, s: ti.i32, count: ti.i32) -> ti.types.vector(7, ti.f32):
        return self.box(s, count)

    @ti.kernel
    def box64(self, s: ti.i32, count: ti.i32) -> ti.types.vector(7, ti.f64):
        return self.box(s, count)

    def bounds(self, s: int, count: int):
        """Lower corner, upper corner [m] and the largest speed [m/s] of the particles at substep s."""
        return (self.box64 if self.real == ti.f64 else self.box32)(s, count)

    @ti.kernel
    def set_window(self, ox: ti.i32, oy: ti.i32, oz: ti.i32, nx: ti.i32, ny: ti.i32, nz: ti.i32):
        """Make this the window; the error flags are cleared."""
        self.window_origin[None] = ti.Vector([ox, oy, oz])
        self.window_shape[None] = ti.Vector([nx, ny, nz])
        for i in ti.static(range(2)):
            self.error_substep[i] = NO_ERROR
            self.error_particle[i] = NO_ERROR

    @ti.kernel
    def errors(self) -> ti.types.vector(4, ti.i32):
        return ti.Vector(
            [self.error_substep[TOO_FAST], self.error_particle[TOO_FAST],
             self.error_substep[OUTSIDE], self.error_particle[OUTSIDE]]
        )  # fmt: skip

    def read_errors(self) -> tuple[tuple[int, int] | None, ...]:
        """First (substep, particle) that is too fast or not finite; that left the window. None if there is none."""
        found = self.errors()
        return tuple(None if found[i] == NO_ERROR else (int(found[i]), int(found[i + 1])) for i in (0, 2))

    # ---- adjoint -------------------------------------------------------------------------------------------------
    # ``*_bar`` hold the adjoint of the state after substep s; each kernel replaces them by that before it.

    @ti.func
    def g2p_adjoint_particle(self, t: ti.i32, s: ti.i32, p: ti.i32):
        dx, dt = self.constants[DX], self.constants[DT]
        local, fx, _ = self.stencil(self.position[s, p], dx)
        ny, nz = self.window_shape[None][1], self.window_shape[None][2]
        w, g = self.weights(fx), self.weight_gradients(fx)
        trial_bar = self.trial_bar[p]
        affine = self.affine_velocity[s + 1, p]
        v_bar = self.velocity_bar[p] + dt * self.position_bar[p]
        c_bar = self.affine_bar[p] + dt * (trial_bar @ self.deformation_gradient[s, p].transpose())
        self.gradient_bar[p] = trial_bar + dt * (affine.transpose() @ trial_bar)
        # v_i gets w (v_bar + 4/dx^2 C_bar d_ip); written from the stencil's corner, in cells.
        slope = (4.0 / dx) * c_bar
        corner = v_bar - slope @ fx
        x_bar = ti.Vector.zero(self.real, 3)
        for i in range(3):
            row = ((local[0] + i) * ny + local[1]) * nz + local[2]
            for j in ti.static(range(3)):
                weight = w[i, 0] * w[j, 1]
                push_j = corner + i * column(slope, 0) + j * column(slope, 1)
                along, along_gradient = ti.cast(0.0, self.real), ti.cast(0.0, self.real)
                for k in ti.static(range(3)):
                    node = row + j * nz + k
                    push = push_j + k * column(slope, 2)
                    value = (weight * w[k, 2]) * push
                    self.add(t, node, ti.Vector([value[0], value[1], value[2], 0.0]))
                    dot = momentum_of(self.grid_velocity[node]).dot(push)
                    along += w[k, 2] * dot
                    along_gradient += g[k, 2] * dot
                x_bar += ti.Vector([g[i, 0] * w[j, 1] * along, w[i, 0] * g[j, 1] * along, weight * along_gradient])
        self.position_bar[p] += (x_bar - slope.transpose() @ self.velocity[s + 1, p]) / dx

    @ti.kernel
    def g2p_adjoint(self, s: ti.i32, count: ti.i32, nodes: ti.i32):
        if ti.static(self.gpu):
            for n in range(nodes):
                self.partial_grids[0, n] = ti.Vector.zero(self.real, 4)
            for p in range(count):
                self.g2p_adjoint_particle(0, s, p)
        else:
            ti.loop_config(block_dim=1)
            for t in range(self.chunks):
                for n in range(nodes):
                    self.partial_grids[t, n] = ti.Vector.zero(self.real, 4)
                for p in range(t * count // self.chunks, (t + 1) * count // self.chunks):
                    self.g2p_adjoint_particle(t, s, p)

    @ti.func
    def p2g_adjoint_particle(self, s: ti.i32, p: ti.i32):
        dx, dt, mass = self.constants[DX], self.constants[DT], self.particle_mass[p]
        local, fx, _ = self.stencil(self.position[s, p], dx)
        ny, nz = self.window_shape[None][1], self.window_shape[None][2]
        w, g = self.weights(fx), self.weight_gradients(fx)
        stress_factor = dt * self.constants[VOLUME] * 4.0 / (dx * dx)
        affine = mass * self.affine_velocity[s, p] - stress_factor * self.kirchhoff_stress[s, p]
        corner = mass * self.velocity[s, p] - affine @ (fx * dx)
        step = dx * affine
        total = ti.Vector.zero(self.real, 4)  # sum w bar
        b0, b1, b2 = ti.Vector.zero(self.real, 4), ti.Vector.zero(self.real, 4), ti.Vector.zero(self.real, 4)
        x_bar = ti.Vector.zero(self.real, 3)
        for i in range(3):
            row = ((local[0] + i) * ny + local[1]) * nz + local[2]
            plane = ti.Vector.zero(self.real, 4)
            for j in ti.static(range(3)):
                weight = w[i, 0] * w[j, 1]
                momentum_j = corner + i * column(step, 0) + j * column(step, 1)
                along, along_gradient = ti.cast(0.0, self.real), ti.cast(0.0, self.real)
                line, tilt = ti.Vector.zero(self.real, 4), ti.Vector.zero(self.real, 4)
                for k in ti.static(range(3)):
                    bar = self.grid_momentum_bar[row + j * nz + k]
                    momentum = momentum_j + k * column(step, 2)
                    dot = momentum.dot(momentum_of(bar)) + mass * bar[3]
                    along += w[k, 2] * dot
                    along_gradient += g[k, 2] * dot
                    line += w[k, 2] * bar
                    tilt += (k * w[k, 2]) * bar
                x_bar += ti.Vector([g[i, 0] * w[j, 1] * along, w[i, 0] * g[j, 1] * along, weight * along_gradient])
                plane += w[j, 1] * line
                b1 += (weight * j) * line
                b2 += weight * tilt
            total += w[i, 0] * plane
            b0 += (w[i, 0] * i) * plane
        v_bar = momentum_of(total)
        affine_bar = dx * (by_columns(b0, b1, b2) - v_bar.outer_product(fx))
        self.position_bar[p] += x_bar / dx - affine.transpose() @ v_bar
        self.mass_bar[p] += self.velocity[s, p].dot(v_bar) + (self.affine_velocity[s, p] * affine_bar).sum() + total[3]
        self.velocity_bar[p] = mass * v_bar
        self.affine_bar[p] = mass * affine_bar
        self.stress_bar[p] = -stress_factor * affine_bar

    @ti.kernel
    def p2g_adjoint(self, s: ti.i32, count: ti.i32):
        for p in range(count):
            self.p2g_adjoint_particle(s, p)

    # ---- to and from torch -------------------------------------------------------------------------------------------

    @ti.kernel
    def write_state(
        self,
        s: ti.i32,
        position: ti.types.ndarray(),
        velocity: ti.types.ndarray(),
        affine: ti.types.ndarray(),
        trial: ti.types.ndarray(),
    ):
        for p in range(position.shape[0]):
            for a in ti.static(range(3)):
                self.position[s, p][a] = position[p, a]
                self.velocity[s, p][a] = velocity[p, a]
                for b in ti.static(range(3)):
                    self.affine_velocity[s, p][a, b] = affine[p, a, b]
                    self.trial_gradient[s, p][a, b] = trial[p, a, b]

    @ti.kernel
    def read_state(
        self,
        s: ti.i32,
        position: ti.types.ndarray(),
        velocity: ti.types.ndarray(),
        affine: ti.types.ndarray(),
        trial: ti.types.ndarray(),
    ):
        for p in range(position.shape[0]):
            for a in ti.static(range(3)):
                position[p, a] = self.position[s, p][a]
                velocity[p, a] = self.velocity[s, p][a]
                for b in ti.static(range(3)):
                    affine[p, a, b] = self.affine_velocity[s, p][a, b]
                    trial[p, a, b] = self.trial_gradient[s, p][a, b]

    @ti.kernel
    def read_stress(self, s: ti.i32, gradient: ti.types.ndarray(), kirchhoff: ti.types.ndarray()):
        """Elastic deformation gradient and Kirchhoff stress in substep s."""
        for p in range(gradient.shape[0]):
            for a in ti.static(range(3)):
                for b in ti.static(range(3)):
                    gradient[p, a, b] = self.deformation_gradient[s, p][a, b]
                    kirchhoff[p, a, b] = self.kirchhoff_stress[s, p][a, b]

    @ti.kernel
    def write_mass(self, mass: ti.types.ndarray()):
        for p in range(mass.shape[0]):
            self.particle_mass[p] = mass[p]

    @ti.kernel
    def read_mass_bar(self, out: ti.types.ndarray()):
        for p in range(out.shape[0]):
            out[p] = self.mass_bar[p]

    @ti.kernel
    def read_position(self, s: ti.i32, position: ti.types.ndarray()):
        for p in range(position.shape[0]):
            for a in ti.static(range(3)):
                position[p, a] = self.position[s, p][a]

    @ti.kernel
    def add_position_bar(self, bar: ti.types.ndarray()):
        for p in range(bar.shape[0]):
            for a in ti.static(range(3)):
                self.position_bar[p][a] += bar[p, a]

    @ti.kernel
    def clear_bars(self, count: ti.i32):
        for p in range(count):
            self.position_bar[p] = ti.Vector.zero(self.real, 3)
            self.velocity_bar[p] = ti.Vector.zero(self.real, 3)
            self.affine_bar[p] = ti.Matrix.zero(self.real, 3, 3)
            self.trial_bar[p] = ti.Matrix.zero(self.real, 3, 3)
            self.mass_bar[p] = 0.0

    @ti.kernel
    def read_bars(
        self,
        position: ti.types.ndarray(),
        velocity: ti.types.ndarray(),
        affine: ti.types.ndarray(),
        trial: ti.types.ndarray(),
    ):
        for p in range(position.shape[0]):
            for a in ti.static(range(3)):
                position[p, a] = self.position_bar[p][a]
                velocity[p, a] = self.velocity_bar[p][a]
                for b in ti.static(range(3)):
                    affine[p, a, b] = self.affine_bar[p][a, b]
                    trial[p, a, b] = self.trial_bar[p][a, b]
