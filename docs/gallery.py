"""Make the clips of the effects gallery: the same soft cube, simulated without (left) and with (right) each effect.

python docs/gallery.py [EFFECT …]          (a minute or two for all; clips are written to docs/gallery)
"""

import functools
import sys
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from masiv import runtime
from masiv.effects.catalogue import causes, effect_named
from masiv.materials.classical import ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.scene.camera import Camera
from masiv.scene.scene import Ground
from masiv.simulation.simulate import simulate
from masiv.synth.picture import Surface, background, enlarged_camera, picture
from masiv.synth.texture import solid_color
from masiv.twin import Twin
from masiv.twin.body import TwinEffect

CLIPS = Path(__file__).parent / "gallery"
EDGE, COUNT = 0.42, 9
"""Edge of the cube [m], and particles along it."""
FPS, FRAMES = 25.0, 34
WIDTH, HEIGHT, SUPERSAMPLING, SEED = 228, 200, 2, 3
QUALITY = 62
UP = np.array([0.0, 1.0, 0.0])
SOFT = {"youngs_modulus": 3e4, "poissons_ratio": 0.3}


@dataclass(frozen=True)
class Show:
    """What shows an effect: its parameters by name, and how the cube starts; m, m/s, rad/s, world axes (y up)."""

    values: dict[str, float]
    centre: tuple[float, float, float] = (-0.45, 0.7, 0.0)
    velocity: tuple[float, float, float] = (0.75, 0.6, 0.0)
    omega: tuple[float, float, float] = (0.0, 0.0, -2.0)
    contact: str = "sticky"
    law: dict[str, float] = field(default_factory=lambda: SOFT)


DROP = {"centre": (0.0, 0.7, 0.0), "velocity": (0.0, 0.0, 0.0), "omega": (0.0, 0.0, 0.0)}
JELLY = {"law": {"youngs_modulus": 7e3, "poissons_ratio": 0.35}}
SLIDE = {"centre": (-0.5, 0.24, 0.0), "velocity": (1.1, 0.0, 0.0), "omega": (0.0, 0.0, 0.0)}
SHOWN = {
    "anisotropy": Show({"fibre_modulus": 6e4, "inclination_x": 0.0, "inclination_z": 0.0}, **DROP, **JELLY),
    "body_force": Show({"acceleration_x": -1.3, "acceleration_y": 0.0, "acceleration_z": 0.5}),
    "drag_crisis": Show({"coefficient_below": 2.5, "coefficient_above": 0.2, "critical_speed": 1.0}),
    "gravity_scale": Show({"relative_change": -0.5}),
    "ground_friction": Show({"slipperiness": 20.0}, **SLIDE),
    "ground_height": Show({"height": 0.2}, **DROP),
    "hidden_obstacle": Show({"radius": 0.13, "x": 0.1, "y": 0.2, "z": 0.0}, **DROP),
    "hung_mass": Show({"mass": 40.0, "x": -0.64, "y": 0.7, "z": 0.0, "length": 0.3}),
    "internal_pressure": Show({"pressure": 1.5e4}, **DROP),
    "linear_drag": Show({"rate": 3.0}),
    "magnus": Show({"lift_rate_x": 0.0, "lift_rate_y": -2.5, "lift_rate_z": 0.0}, omega=(0.0, -8.0, 0.0)),
    "periodic_force": Show(
        {"cosine_x": 12.0, "cosine_y": 0.0, "cosine_z": 0.0, "sine_x": 0.0, "sine_y": 0.0, "sine_z": 0.0,
         "frequency": 2.0}, (0.0, 0.45, 0.0), (0.0, 2.6, 0.0), (0.0, 0.0, 0.0),
    ),
    "point_force": Show({"force_x": 0.0, "force_y": 200.0, "force_z": 0.0, "x": -0.6, "y": 0.7, "z": 0.0}),
    "point_mass": Show({"mass": 25.0, "x": 0.2, "y": 0.7, "z": 0.0}, **DROP),
    "quadratic_drag": Show({"coefficient": 2.0}),
    "relaxation": Show(
        {"fraction_1": 1.0, "fraction_2": 1.0, "fraction_3": 0.0, "time_1": 0.02, "time_2": 0.1, "time_3": 1.0},
        **DROP, **JELLY,
    ),
    "restitution": Show({"coefficient": 0.8}, **DROP),
    "stiffness_contrast": Show(
        {"log_stiffness_ratio": 2.0, "x": -0.15, "y": 0.52, "z": 0.1, "radius": 0.2}, **DROP, **JELLY
    ),
    "stiffness_contrast_half_space": Show(
        {"log_stiffness_ratio": 2.5, "inclination_x": 1.571, "inclination_z": 0.0, "offset": 0.0, "width": 0.03},
        **DROP, **JELLY,
    ),
    "swirl": Show({"strength": 6.0, "x": 0.0, "z": -0.2}, (-0.15, 0.6, -0.2), (0.0, 1.5, 0.0), (0.0, 0.0, 0.0)),
    "time_offset": Show({"delay": 0.1}),
    "viscosity": Show({"viscosity": 40.0}, **DROP, **JELLY),
}  # fmt: skip
"""Every effect that a search may name. Much stronger than what ``masiv refine`` finds, so that one sees them."""


def cube() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Particles (Q, 3) [m] about the origin; which of them are on the surface (S,); triangles (F, 3) of these."""
    axis = (np.arange(COUNT) + 0.5) / COUNT * EDGE - EDGE / 2
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    index = np.arange(COUNT**3).reshape((COUNT,) * 3)
    triangles = []
    for k in range(3):
        for side in (0, -1):
            sheet = np.moveaxis(index, k, 0)[side]
            a, b, c, d = sheet[:-1, :-1], sheet[1:, :-1], sheet[1:, 1:], sheet[:-1, 1:]
            corners = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
            outward = (side == -1) != (k == 1)  # counter-clockwise as seen from outside
            triangles.append(corners if outward else corners[:, ::-1])
    surface, faces = np.unique(np.concatenate(triangles), return_inverse=True)
    return points, surface, faces.reshape(-1, 3)


def twin_of(show: Show, effect: str | None) -> Twin:
    """The cube of ``show``, with the effect or without any."""
    points, _, _ = cube()
    acting = () if effect is None else (TwinEffect(effect, show.values),)
    return Twin.of_body(
        positions=points + show.centre, velocity=np.array(show.velocity), omega=np.array(show.omega),
        gravity=-9.8 * UP, ground=Ground(UP, 0.0), contact=show.contact, volume=EDGE**3, density=1000.0, up=UP, fps=FPS,
        law=ClassicalLaw("neo_hookean", **show.law), simulator=SimulatorConfig(subparticles=1, particles_per_cell=4),
        effects=acting,
    )  # fmt: skip


def camera() -> Camera:
    """In front of the scene, a little above, so that the ground is seen."""
    centre, target = np.array([0.5, 1.1, 2.9]), np.array([0.0, 0.44, 0.0])
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    focal = 2.3 * HEIGHT
    return Camera("front", WIDTH, HEIGHT, np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]]), pose)


def pictures(positions: np.ndarray) -> list[np.ndarray]:
    """The motion (T, Q, 3) as pictures (H, W, 3) uint8."""
    points, surface, faces = cube()
    view = camera()
    empty = background(enlarged_camera(view, SUPERSAMPLING), SEED)
    patches = functools.partial(solid_color, "patches", seed=SEED)
    made = []
    for now in positions:
        body = Surface(now[surface].astype(np.float64), faces, points[surface] / EDGE * 0.35)
        made.append((255 * picture(view, empty, body, patches, SUPERSAMPLING)[0]).round().astype(np.uint8))
    return made


def clip(effect: str) -> list[np.ndarray]:
    """Both motions beside each other: pictures (H, 2 W + 4, 3) uint8 RGB."""
    show = SHOWN[effect]
    assert set(show.values) == {p.name for p in effect_named(effect).parameters}
    halves = [pictures(simulate(twin_of(show, name), frames=FRAMES).positions) for name in (None, effect)]
    gap = np.full((HEIGHT, 4, 3), 255, np.uint8)
    return [np.hstack([without, gap, with_it]) for without, with_it in zip(*halves, strict=True)]


def write(frames: list[np.ndarray], path: Path) -> None:
    """As an animated WebP that repeats."""
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in (*frames, *[frames[-1]] * 10)]
    animation.durations = np.full(len(animation.frames), 1000 / FPS, np.int32)
    path.parent.mkdir(exist_ok=True)
    cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


def main(names: list[str]) -> None:
    runtime.start("cpu")
    for name in names or list(causes()):
        path = CLIPS / f"{name}.webp"
        write(clip(name), path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
