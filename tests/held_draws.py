"""Fresh draws of bodies that fly, bounce, rest, swing or hang, tracked with white noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from masiv.scene.scene import Ground
from masiv.tracks.declaration import GeometryDeclaration
from masiv.tracks.geometry import make_geometry
from masiv.tracks.placement import Placement
from masiv.tracks.tracks import Clamp, Run, TrackedBody, Tracks

UP = np.array([0.0, 0.0, 1.0])
G = 9.8
AIR = 1.2


def scene(positions, times, *, ground=None, mass=0.06, diameter=0.065, clamp=None, box=None, own=None, known=True):
    """Tracks of one body with markers at ``positions`` (T, M, 3) [m]; ``own`` (M, 3): where they are on the body."""
    positions = positions if positions.ndim == 3 else positions[:, None]
    shape = {"sphere": diameter, "units": "m"} if box is None else {"box": list(box), "units": "m"}
    geometry = make_geometry(GeometryDeclaration.model_validate(shape), Path())
    body = TrackedBody(
        "body", "body", geometry if known else None, mass / geometry.volume if known else None,
        mass if known else None, None, () if clamp is None else (clamp,),
    )  # fmt: skip
    names = tuple(f"m{k}" for k in range(positions.shape[1]))
    at_rest = positions[0] if own is None else own
    placement = Placement(np.eye(3), np.zeros(3)) if own is not None else None
    run = Run("run", "body", "", "fit", names, times, positions, 1 / float(np.median(np.diff(times))), None, at_rest,
              None, None, placement)  # fmt: skip
    plane = None if ground is None else Ground(UP, ground)
    return Tracks(Path("scene"), UP, -G * UP, plane, {"body": body}, (run,)), run


def flight(random, times, rate=None):
    """Path (T, 3) [m] of a thrown ball with quadratic drag ``rate`` [1/m]."""
    rate = 10 ** random.uniform(-3, 0.5) if rate is None else rate
    start = np.concatenate([[0, 0, 5], random.normal(0, 3, 3)])

    def slope(_, s):
        return [*s[3:], *(-rate * np.linalg.norm(s[3:]) * s[3:] - G * UP)]

    return solve_ivp(slope, (0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-9).y[:3].T


def drag_rate(mass, diameter, coefficient=0.5):
    """[1/m] of a sphere in air."""
    return AIR * coefficient * np.pi * diameter**2 / (8 * mass)


def bounce(random, times):
    """Path (T, 3) [m] of a ball that jumps on the ground z = 0, its middle at 0.0325 m at least."""
    height, velocity, e = random.uniform(0.3, 1.5), 0.0, random.uniform(0.4, 0.9)
    out, now, z = [], 0.0, height
    for t in times:
        while now < t - 1e-12:
            step = min(1e-4, t - now)
            z, velocity, now = z + velocity * step - 0.5 * G * step**2, velocity - G * step, now + step
            if z < 0.0325 and velocity < 0:
                z, velocity = 0.0325, -e * velocity if velocity < -0.05 else 0.0
        out.append(z)
    return np.stack([0.5 * times, 0 * times, np.array(out)], axis=1)


def pendulum(random, times, length=None, amplitude=None):
    """Path (T, 3) [m] of a bob on a thread from (0, 0, 3), with a little damping."""
    length = random.uniform(0.3, 2.0) if length is None else length
    amplitude = random.uniform(0.15, 0.8) if amplitude is None else amplitude
    angle = solve_ivp(
        lambda _, s: [s[1], -G / length * np.sin(s[0]) - 0.05 * s[1]], (0, times[-1]), [amplitude, 0], t_eval=times,
        rtol=1e-9, atol=1e-9,
    ).y[0]  # fmt: skip
    turn = random.uniform(0, 2 * np.pi)
    across = length * np.sin(angle)
    return np.stack([across * np.cos(turn), across * np.sin(turn), 3 - length * np.cos(angle)], axis=1)


def tumbling_box(random, times, sides):
    """Markers (T, 4, 3) [m] on one face of a box that flies and turns, and where they are on it (4, 3)."""
    half = np.array(sides) / 2
    own = half * np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]])
    centre = flight(random, times, 0.0)
    turns = Rotation.from_rotvec(times[:, None] * random.normal(0, 10, 3)).as_matrix()
    return np.einsum("tij,mj->tmi", turns, own) + centre[:, None], own


def declared_clamp():
    """A half space that holds the top of a body."""
    return Clamp(np.array([[0.0, 0.0, -1.0]]), np.array([0.0]), ())
