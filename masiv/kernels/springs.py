"""Substeps of a spring network (springs with dashpots between particles) and their hand-written adjoints.

Bonds are in compressed rows: those of particle p are offsets[p] … offsets[p + 1] - 1, each bond in the rows of both of
its ends. With d = x_j - x_p, r = |d|, n = d / r, w = v_j - v_p the particle gets

    f_p = sum_j (stiffness (r / length - 1) + damping (w . n)) n,

stiffness [N], damping [N s/m]. Positions and velocities are (S, N, 3); entry s is the state before substep s.

On a CPU a kernel with many substeps runs on one thread: for few particles a launch costs more than the second thread
gains.
"""

import taichi as ti

from masiv.kernels.grid import NO_GROUND, contact_adjoint, contact_velocity

DT, GRAVITY_X, GRAVITY_Y, GRAVITY_Z, FRICTION, RADIUS, SPACING, TIME = range(8)
"""Entries of ``constants``. RADIUS [m]: half the distance of particles, at which one touches the ground."""
MAX_SPEED = 1e6
"""Speed [m/s] beyond which a particle counts as not finite."""


@ti.func
def row3(a: ti.template(), s: ti.i32, p: ti.i32):
    return ti.Vector([a[s, p, 0], a[s, p, 1], a[s, p, 2]])


@ti.func
def row2(a: ti.template(), p: ti.i32):
    return ti.Vector([a[p, 0], a[p, 1], a[p, 2]])


@ti.func
def set_row3(a: ti.template(), s: ti.i32, p: ti.i32, value):
    for k in ti.static(range(3)):
        a[s, p, k] = value[k]


@ti.func
def set_row2(a: ti.template(), p: ti.i32, value):
    for k in ti.static(range(3)):
        a[p, k] = value[k]


@ti.kernel
def write_row(a: ti.types.ndarray(), s: ti.i32, values: ti.types.ndarray()):
    """values (N, 3) -> a[s]."""
    for p in range(a.shape[1]):
        set_row3(a, s, p, row2(values, p))


@ti.kernel
def read_row(a: ti.types.ndarray(), s: ti.i32, out: ti.types.ndarray()):
    """a[s] -> out (N, 3)."""
    for p in range(a.shape[1]):
        set_row2(out, p, row3(a, s, p))


@ti.kernel
def add(a: ti.types.ndarray(), values: ti.types.ndarray()):
    """a (N, 3) += values (N, 3)."""
    for p in range(a.shape[0]):
        set_row2(a, p, row2(a, p) + row2(values, p))


@ti.func
def bond_force(
    x: ti.template(), v: ti.template(), s: ti.i32, p: ti.i32, offsets: ti.template(), others: ti.template(),
    lengths: ti.template(), stiffness: ti.template(), damping: ti.template(),
):  # fmt: skip
    here, own = row3(x, s, p), row3(v, s, p)
    f = 0.0 * here
    for e in range(offsets[p], offsets[p + 1]):
        d = row3(x, s, others[e]) - here
        r = d.norm()
        if r > 0.0:  # ends in one place have no direction
            n = d / r
            speed = (row3(v, s, others[e]) - own).dot(n)
            f += (stiffness[e] * (r / lengths[e] - 1.0) + damping[e] * speed) * n
    return f


@ti.func
def free_velocity(
    x: ti.template(), v: ti.template(), s: ti.i32, p: ti.i32, offsets: ti.template(), others: ti.template(),
    lengths: ti.template(), stiffness: ti.template(), damping: ti.template(), force: ti.template(),
    mass: ti.template(), constants: ti.template(),
):  # fmt: skip
    """v[s] + dt ((springs + force) / m + g), and the force [N] without gravity."""
    f = bond_force(x, v, s, p, offsets, others, lengths, stiffness, damping) + row2(force, p)
    gravity = ti.Vector([constants[GRAVITY_X], constants[GRAVITY_Y], constants[GRAVITY_Z]])
    return row3(v, s, p) + constants[DT] * (f / mass[p] + gravity), f


@ti.func
def pressed(x: ti.template(), s: ti.i32, p: ti.i32, v, contact: ti.i32, constants: ti.template()):
    """Whether a particle with velocity v touches the ground and moves into it."""
    return contact != NO_GROUND and x[s, p, 1] <= constants[RADIUS] and v[1] < 0.0


@ti.func
def finish(x: ti.template(), v: ti.template(), s: ti.i32, p: ti.i32, now, contact: ti.i32, constants: ti.template()):
    """Contact, then the state at s + 1; whether it is finite."""
    after = now
    if pressed(x, s, p, now, contact, constants):
        after = contact_velocity(now, contact, constants[FRICTION])
    set_row3(v, s + 1, p, after)
    set_row3(x, s + 1, p, row3(x, s, p) + constants[DT] * after)
    return after.norm() < MAX_SPEED  # false for NaN


@ti.kernel
def advance(
    begin: ti.i32, end: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), offsets: ti.types.ndarray(),
    others: ti.types.ndarray(), lengths: ti.types.ndarray(), stiffness: ti.types.ndarray(), damping: ti.types.ndarray(),
    force: ti.types.ndarray(), mass: ti.types.ndarray(), contact: ti.i32, constants: ti.types.ndarray(),
) -> ti.i32:  # fmt: skip
    """Substeps begin … end - 1 on one thread. Returns s N + p of the first state that is not finite, -1 if all are."""
    bad = -1
    ti.loop_config(serialize=True)
    for s in range(begin, end):
        for p in range(mass.shape[0]):
            now, _ = free_velocity(
                x, v, s, p, offsets, others, lengths, stiffness, damping, force, mass, constants
            )  # fmt: skip
            if not finish(x, v, s, p, now, contact, constants) and bad < 0:
                bad = s * mass.shape[0] + p
    return bad


@ti.kernel
def accelerate(
    s: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), offsets: ti.types.ndarray(), others: ti.types.ndarray(),
    lengths: ti.types.ndarray(), stiffness: ti.types.ndarray(), damping: ti.types.ndarray(), force: ti.types.ndarray(),
    mass: ti.types.ndarray(), constants: ti.types.ndarray(),
):  # fmt: skip
    """v[s + 1] after springs, forces and gravity: the first part of a substep on all threads."""
    for p in range(mass.shape[0]):
        now, _ = free_velocity(x, v, s, p, offsets, others, lengths, stiffness, damping, force, mass, constants)
        set_row3(v, s + 1, p, now)


@ti.kernel
def touch_and_move(
    s: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), contact: ti.i32, constants: ti.types.ndarray()
) -> ti.i32:  # fmt: skip
    """The second part: contact, positions. Returns as ``advance``."""
    bad = x.shape[1]
    for p in range(x.shape[1]):
        if not finish(x, v, s, p, row3(v, s + 1, p), contact, constants):
            ti.atomic_min(bad, p)
    out = -1
    if bad < x.shape[1]:
        out = s * x.shape[1] + bad
    return out


@ti.func
def pull_state(
    s: ti.i32, p: ti.i32, x: ti.template(), v: ti.template(), offsets: ti.template(), others: ti.template(),
    lengths: ti.template(), stiffness: ti.template(), damping: ti.template(), force: ti.template(),
    mass: ti.template(), contact: ti.i32, constants: ti.template(), x_bar: ti.template(), v_bar: ti.template(),
    f_bar: ti.template(), force_bar: ti.template(), mass_bar: ti.template(),
):  # fmt: skip
    dt = constants[DT]
    now, f = free_velocity(x, v, s, p, offsets, others, lengths, stiffness, damping, force, mass, constants)
    bar = row2(v_bar, p) + dt * row2(x_bar, p)
    if pressed(x, s, p, now, contact, constants):
        bar = contact_adjoint(now, bar, contact, constants[FRICTION])
    push = (dt / mass[p]) * bar
    set_row2(v_bar, p, bar)
    set_row2(f_bar, p, push)
    set_row2(force_bar, p, row2(force_bar, p) + push)
    mass_bar[p] -= f.dot(push) / mass[p]


@ti.func
def pull_bonds(
    s: ti.i32, p: ti.i32, x: ti.template(), v: ti.template(), offsets: ti.template(), others: ti.template(),
    lengths: ti.template(), stiffness: ti.template(), damping: ti.template(), x_bar: ti.template(),
    v_bar: ti.template(), f_bar: ti.template(), stiffness_bar: ti.template(), damping_bar: ti.template(),
):  # fmt: skip
    here, own, push = row3(x, s, p), row3(v, s, p), row2(f_bar, p)
    of_x, of_v = 0.0 * here, 0.0 * here
    for e in range(offsets[p], offsets[p + 1]):
        j = others[e]
        d = row3(x, s, j) - here
        r = d.norm()
        if r > 0.0:
            n = d / r
            w, q = row3(v, s, j) - own, push - row2(f_bar, j)
            along, speed, strain = q.dot(n), w.dot(n), r / lengths[e] - 1.0
            tension = stiffness[e] * strain + damping[e] * speed
            turn = (tension * (q - along * n) + along * damping[e] * (w - speed * n)) / r
            of_x -= turn + (along * stiffness[e] / lengths[e]) * n
            of_v -= along * damping[e] * n
            stiffness_bar[e] += 0.5 * along * strain
            damping_bar[e] += 0.5 * along * speed
    set_row2(x_bar, p, row2(x_bar, p) + of_x)
    set_row2(v_bar, p, row2(v_bar, p) + of_v)


@ti.kernel
def advance_adjoint(
    begin: ti.i32, end: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), offsets: ti.types.ndarray(),
    others: ti.types.ndarray(), lengths: ti.types.ndarray(), stiffness: ti.types.ndarray(), damping: ti.types.ndarray(),
    force: ti.types.ndarray(), mass: ti.types.ndarray(), contact: ti.i32, constants: ti.types.ndarray(),
    x_bar: ti.types.ndarray(), v_bar: ti.types.ndarray(), f_bar: ti.types.ndarray(), force_bar: ti.types.ndarray(),
    mass_bar: ti.types.ndarray(), stiffness_bar: ti.types.ndarray(), damping_bar: ti.types.ndarray(),
):  # fmt: skip
    """Adjoints x_bar, v_bar (N, 3) of the state before substep ``end`` -> of that before ``begin``; those of the inputs
    are added up. f_bar: scratch. Of the adjoints of a bond each of its two entries gets half."""
    ti.loop_config(serialize=True)
    for back in range(end - begin):
        s = end - 1 - back
        for p in range(mass.shape[0]):
            pull_state(
                s, p, x, v, offsets, others, lengths, stiffness, damping, force, mass, contact, constants, x_bar,
                v_bar, f_bar, force_bar, mass_bar,
            )  # fmt: skip
        for p in range(mass.shape[0]):
            pull_bonds(
                s, p, x, v, offsets, others, lengths, stiffness, damping, x_bar, v_bar, f_bar, stiffness_bar,
                damping_bar,
            )  # fmt: skip


@ti.kernel
def state_adjoint(
    s: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), offsets: ti.types.ndarray(), others: ti.types.ndarray(),
    lengths: ti.types.ndarray(), stiffness: ti.types.ndarray(), damping: ti.types.ndarray(), force: ti.types.ndarray(),
    mass: ti.types.ndarray(), contact: ti.i32, constants: ti.types.ndarray(), x_bar: ti.types.ndarray(),
    v_bar: ti.types.ndarray(), f_bar: ti.types.ndarray(), force_bar: ti.types.ndarray(), mass_bar: ti.types.ndarray(),
):  # fmt: skip
    """The first part of the adjoint of substep s on all threads: all but what goes through the bonds."""
    for p in range(mass.shape[0]):
        pull_state(
            s, p, x, v, offsets, others, lengths, stiffness, damping, force, mass, contact, constants, x_bar, v_bar,
            f_bar, force_bar, mass_bar,
        )  # fmt: skip


@ti.kernel
def bond_adjoint(
    s: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), offsets: ti.types.ndarray(), others: ti.types.ndarray(),
    lengths: ti.types.ndarray(), stiffness: ti.types.ndarray(), damping: ti.types.ndarray(), x_bar: ti.types.ndarray(),
    v_bar: ti.types.ndarray(), f_bar: ti.types.ndarray(), stiffness_bar: ti.types.ndarray(),
    damping_bar: ti.types.ndarray(),
):  # fmt: skip
    """The second part: through the bonds."""
    for p in range(x.shape[1]):
        pull_bonds(
            s, p, x, v, offsets, others, lengths, stiffness, damping, x_bar, v_bar, f_bar, stiffness_bar, damping_bar
        )  # fmt: skip


@ti.data_oriented
class ParticleEffect:
    """A function of an effect on the grid (``masiv.effects.effect``) at the particles in place of the nodes."""

    def __init__(self, function, coefficients: int, on_ground: bool):
        self.function = function
        self.coefficients = coefficients
        self.on_ground = on_ground

    @ti.kernel
    def apply(
        self, s: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), contact: ti.i32, values: ti.types.ndarray(),
        constants: ti.types.ndarray(),
    ):  # fmt: skip
        for p in range(x.shape[1]):
            place, now = row3(x, s, p), row3(v, s + 1, p)
            c = ti.Vector([values[k] for k in ti.static(range(self.coefficients))])
            t, dt, dx = constants[TIME], constants[DT], constants[SPACING]
            if ti.static(self.on_ground):
                if pressed(x, s, p, now, contact, constants):
                    held = contact_velocity(now, contact, constants[FRICTION])
                    set_row3(v, s + 1, p, self.function(place, now, held, t, dt, dx, c))
            else:
                set_row3(v, s + 1, p, self.function(place, now, t, dt, dx, c))
