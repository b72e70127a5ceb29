"""A mass that hangs on a thread: an inextensible one, which pulls and does not push. Or one that is fixed to a body."""

import taichi as ti

from masiv.kernels.grid import DT


@ti.data_oriented
class SuspensionKernels:
    """``place[s]``, ``velocity[s]`` (3,) [m, m/s]: of the mass before substep s. ``weights[p]``: of the particles that
    the thread is tied to, with sum 1. ``load`` [kg] and ``length`` [m] of the thread; without length the
    mass is fixed to where it is tied."""

    def __init__(self, mpm):
        self.mpm = mpm
        steps, real = mpm.capacity_steps, mpm.real
        self.place = ti.Vector.field(3, real, shape=steps + 1)
        self.velocity = ti.Vector.field(3, real, shape=steps + 1)
        self.weights = ti.field(real, shape=mpm.capacity_particles)
        self.load = ti.field(real, shape=())
        self.length = ti.field(real, shape=())

    @ti.kernel
    def write_weights(self, values: ti.types.ndarray()):
        for p in range(values.shape[0]):
            self.weights[p] = values[p]

    @ti.func
    def knot(self, s: ti.i32, count: ti.i32):
        """Mean position and velocity of what the thread is tied to, before substep s; and sum of w² / m [1/kg]."""
        x, v = ti.Vector.zero(self.mpm.real, 3), ti.Vector.zero(self.mpm.real, 3)
        mobility = ti.cast(0.0, self.mpm.real)
        for p in range(count):
            w = self.weights[p]
            x += w * self.mpm.position[s, p]
            v += w * self.mpm.velocity[s, p]
            mobility += w * w / self.mpm.particle_mass[p]
        return x, v, mobility

    @ti.func
    def advance(self, s: ti.i32, count: ti.i32):
        """The mass before substep s from that before s - 1, and the impulse of the thread on it and on the particles.

        With the impulse the ends are not further apart than the thread is long after substep s, but for what the grid
        shares out of the particles' part of it: of the order of the substep squared. Without a thread the impulse acts
        in all directions, and the ends are at one place."""
        dt, load = self.mpm.constants[DT], self.load[None]
        x, v, mobility = self.knot(s, count)
        place, u = self.place[s - 1] + dt * self.velocity[s - 1], self.velocity[s - 1] + dt * self.mpm.gravity()
        taken = ti.Vector.zero(self.mpm.real, 3)
        if self.length[None] > 0.0:
            line = place - x
            distance = line.norm()
            along = line / ti.max(distance, 1e-9)
            parting = (u - v).dot(along) + (distance - self.length[None]) / dt
            taken = (ti.max(parting, 0.0) / (1.0 + load * mobility)) * along
        else:
            # Its path has the order of the particles' (velocity, then place): they fall together to the last digit.
            taken = (self.place[s - 1] + dt * u - x) / (dt * (1.0 + load * mobility))
            place = self.place[s - 1] + dt * (u - taken)
        self.place[s], self.velocity[s] = place, u - taken
        impulse = load * taken
        for p in range(count):
            if self.weights[p] != 0.0:
                self.mpm.velocity[s, p] += (self.weights[p] / self.mpm.particle_mass[p]) * impulse

    @ti.kernel
    def step(self, s: ti.i32, count: ti.i32):
        """``advance`` in a launch of its own. One thread: sums come out alike."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.advance(s, count)

    @ti.kernel
    def hang(self, count: ti.i32):
        """Before substep 0 the mass hangs straight down and moves with what it is tied to."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            x, v, _mobility = self.knot(0, count)
            down = self.mpm.gravity()
            if down.norm() > 0.0:
                down /= down.norm()
            else:
                down = ti.Vector([0.0, -1.0, 0.0], dt=self.mpm.real)
            self.place[0] = x + self.length[None] * down
            self.velocity[0] = v
