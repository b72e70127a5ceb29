"""Which motion tells which property: the table and the pictures of docs/filming.md.

    python benchmarks/filming.py motions          # the table; five minutes on a busy core
    python benchmarks/filming.py pictures         # docs/filming_*.webp

A motion tells a property if 10 % of it moves the body in a way that no other initial velocity and spin would. Bodies
are simulated with ``masiv.synth``: a 0.3 m cube of an elastic or a plastic material, filmed for 0.75 s.
"""

from __future__ import annotations

import argparse
import functools
import io
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from PIL import Image

from masiv import runtime
from masiv.footage.clocks import FLASH_FRAMES
from masiv.shapes import ShapeSpec, make_body
from masiv.synth.motion import Skin, simulate
from masiv.synth.picture import Surface, background, enlarged_camera, picture
from masiv.synth.spec import CameraSpec, MaterialSpec, SynthSpec
from masiv.synth.synthesise import ring
from masiv.synth.texture import solid_color

matplotlib.use("Agg")
from matplotlib import pyplot as plt

DOCS = Path(__file__).parents[1] / "docs"
FPS, FRAMES, PARTICLES, SIZE = 48.0, 37, 1500, 0.3
ELASTIC = MaterialSpec(law="neo_hookean", parameters={"youngs_modulus": 4e4, "poissons_ratio": 0.3})
PLASTIC = MaterialSpec(law="von_mises", parameters={"youngs_modulus": 2e5, "poissons_ratio": 0.3, "yield_stress": 3e3})
EFFECTS = {"linear_drag": {"rate": 0.5}, "viscosity": {"viscosity": 50.0}}
MOTIONS = {
    "dropped from 0.5 m": {"clearance": 0.5},
    "thrown down at 3 m/s": {"clearance": 0.5, "velocity": (0, -3, 0)},
    "thrown far, in flight": {"clearance": 0.5, "velocity": (3, 3, 0)},
    "thrown with spin, lands": {"clearance": 0.3, "velocity": (1, 0, 0), "omega": (0, 3, -10)},
    "pushed along the ground": {"clearance": 0.005, "velocity": (2, 0, 0)},
}
PROPERTIES = ("Young's modulus", "viscosity", "yield stress", "friction", "drag")
STEP = 1.1


def spec_of(motion: dict, material: MaterialSpec, effects: dict, friction: float = 0.3) -> SynthSpec:
    """A cube on its edge, so that an impact deforms it unevenly."""
    shape = ShapeSpec(kind="cube", size=SIZE, rotation_deg=(20, 30, 10), clearance=motion["clearance"])
    state = {key: value for key, value in motion.items() if key != "clearance"}
    return SynthSpec(
        shape=shape, material=material, effects=effects, friction=friction, contact="slip", frames=FRAMES, fps=FPS,
        particles=PARTICLES, **state,
    )  # fmt: skip


def positions(spec: SynthSpec) -> np.ndarray:
    """(T - 1, N, 3) [m] after frame 0."""
    return simulate(spec, make_body(spec.shape, spec.particles)).astype(np.float64)[1:]


def told(motion: dict, material: MaterialSpec, effects: dict, changed: dict[str, SynthSpec]) -> dict[str, float]:
    """RMS displacement [mm] for 10 % more of each property that velocity and spin could not make."""
    spec = spec_of(motion, material, effects)
    base = positions(spec)
    columns = []
    for key, size in (("velocity", 0.02), ("omega", 0.1)):
        for axis in range(3):
            values = list(getattr(spec, key))
            values[axis] += size
            columns.append((positions(spec.model_copy(update={key: tuple(values)})) - base).ravel())
    basis, _ = np.linalg.qr(np.array(columns).T)
    found = {}
    for name, other in changed.items():
        moved = (positions(other) - base).ravel()
        left = moved - basis @ (basis.T @ moved)
        found[name] = 1e3 * float(np.sqrt((left**2).sum() / (base.size / 3)))
    return found


def measure() -> dict[str, dict[str, float]]:
    """Rows of the table: motion -> property -> mm."""
    runtime.start("cpu")
    table = {}
    for name, motion in MOTIONS.items():
        stiffer = ELASTIC.model_copy(
            update={"parameters": {**ELASTIC.parameters, "youngs_modulus": STEP * ELASTIC.parameters["youngs_modulus"]}}
        )
        harder = PLASTIC.model_copy(
            update={"parameters": {**PLASTIC.parameters, "yield_stress": STEP * PLASTIC.parameters["yield_stress"]}}
        )
        more = {key: {p: STEP * v for p, v in value.items()} for key, value in EFFECTS.items()}
        elastic = {
            PROPERTIES[0]: spec_of(motion, stiffer, EFFECTS),
            "viscosity": spec_of(motion, ELASTIC, {**EFFECTS, "viscosity": more["viscosity"]}),
            "friction": spec_of(motion, ELASTIC, EFFECTS, 0.3 * STEP),
            "drag": spec_of(motion, ELASTIC, {**EFFECTS, "linear_drag": more["linear_drag"]}),
        }
        table[name] = told(motion, ELASTIC, EFFECTS, elastic)
        table[name] |= told(motion, PLASTIC, {}, {"yield stress": spec_of(motion, harder, {})})
        print(f"| {name} | " + " | ".join(f"{table[name][p]:.1f}" for p in PROPERTIES) + " |", flush=True)
    return table


def save(figure, name: str) -> None:
    """A WebP of the figure, small enough to be part of the repository."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    Image.open(buffer).convert("RGB").save(DOCS / name, "WEBP", quality=80, method=6)


def draw_cameras() -> None:
    """Where the nine cameras of assets/sample stand, from above and from the side [m]."""
    figure, (above, side) = plt.subplots(1, 2, figsize=(8, 3.2), width_ratios=[1, 1.3], layout="constrained")
    colours = {0.5: "tab:blue", 1.1: "tab:green", 1.9: "tab:orange"}
    target = np.array([0.05, 0.3, 0.0])
    cameras = ring(CameraSpec(count=9, heights=tuple(colours), target=tuple(target)))
    for camera in cameras:
        x, y, z = camera.centre
        colour = colours[round(float(y), 1)]
        for axes, at, to in ((above, (x, -z), (target[0], -target[2])), (side, (x, y), target[:2])):
            axes.plot([at[0], to[0]], [at[1], to[1]], color=colour, lw=0.6)
            axes.plot(*at, "o", color=colour, ms=8)
    above.add_patch(plt.Rectangle((-0.25, -0.3), 0.6, 0.6, angle=20, rotation_point="center", color="0.4"))
    side.add_patch(plt.Rectangle((-0.25, 0.05), 0.6, 0.6, angle=20, rotation_point="center", color="0.4"))
    side.axhline(0, color="0.6", lw=3)
    for height, colour in colours.items():
        side.annotate(f"{height} m high", (2.8, height), fontsize=9, color=colour, va="center")
    above.set_title("from above: 2.4 m away, a body of 0.6 m", fontsize=9)
    side.set_title("from the side", fontsize=9)
    side.set_xlim(-2.8, 4.4)
    for axes in (above, side):
        axes.set_aspect("equal")
        axes.axis("off")
    save(figure, "filming_cameras.webp")


def draw_exposure() -> None:
    """The same instant of a throw with three exposures, and framed too wide: rendered by the renderer of synth."""
    runtime.start("cpu")
    motion = {"clearance": 0.45, "velocity": (2.5, 0, 0), "omega": (0, 2, -8)}
    spec = spec_of(motion, ELASTIC, {}).model_copy(update={"fps": 2000.0, "frames": 120})
    body = make_body(spec.shape, spec.particles)
    moved = simulate(spec, body)
    skin = Skin(body.vertices, body.particles)
    cases = [
        ("1/1000 s", 2, 22.0), ("1/125 s", 16, 22.0), ("1/30 s", 66, 22.0), ("1/1000 s, too far away", 2, 75.0),
    ]  # fmt: skip
    patches = functools.partial(solid_color, "patches", seed=0)
    figure, axes = plt.subplots(1, 4, figsize=(9, 2.6), layout="constrained")
    for ax, (title, span, angle) in zip(axes, cases, strict=True):
        camera = ring(CameraSpec(count=3, size=160, field_of_view_deg=angle, target=(0.1, 0.55, 0), heights=(1.1,)))[0]
        empty = background(enlarged_camera(camera, 2), 0)
        frames = range(60 - span // 2, 60 + span // 2, max(1, span // 16))
        surfaces = (Surface(skin.at(moved[k].astype(np.float64)), body.faces, body.local) for k in frames)
        mean = np.mean([picture(camera, empty, s, patches, 2)[0] for s in surfaces], axis=0)
        ax.imshow(mean)
        ax.set_title(title, fontsize=9)
        ax.axis("off")
    save(figure, "filming_exposure.webp")


def draw_clocks() -> None:
    """What --sync flash and --sync clap look at: brightness and loudness of two recordings."""
    rng = np.random.default_rng(0)
    figure, (light, loud) = plt.subplots(2, 1, figsize=(8, 3.6), layout="constrained")
    for name, at, colour in (("left", 1.2, "tab:blue"), ("right", 1.9, "tab:orange")):
        times = np.arange(120) / 30
        grey = 90 + 2 * np.sin(times) + rng.normal(0, 0.3, 120)
        start = int(np.ceil(at * 30))
        grey[start : start + FLASH_FRAMES] += 45
        light.plot(times, grey, ".-", ms=3, lw=0.8, color=colour, label=name)
        light.axvline(times[start], color=colour, lw=0.8, ls=":")
        seconds = np.arange(4000) / 1000
        noise = 0.05 * np.abs(rng.normal(size=4000))
        clap = np.where(seconds >= at, 0.8 * np.exp(-(seconds - at) / 0.05), 0)
        loud.plot(seconds, noise + clap, lw=0.6, color=colour)
        loud.axvline(at, color=colour, lw=0.8, ls=":")
    light.set_ylabel("mean grey level")
    loud.set_ylabel("amplitude")
    loud.set_xlabel("time in the recording [s]")
    light.legend(frameon=False, fontsize=9)
    save(figure, "filming_clocks.webp")


def draw_motions() -> None:
    """The paths of the centre and the body at some instants, for each motion of the table."""
    runtime.start("cpu")
    figure, axes = plt.subplots(1, len(MOTIONS), figsize=(10, 2.4), layout="constrained")
    for ax, (name, motion) in zip(axes, MOTIONS.items(), strict=True):
        spec = spec_of(motion, ELASTIC, EFFECTS)
        moved = simulate(spec, make_body(spec.shape, spec.particles))
        for frame in np.linspace(0, FRAMES - 1, 5).astype(int):
            outline = cv2.convexHull(moved[frame][:, :2].astype(np.float32))[:, 0]
            shade = plt.get_cmap("viridis")(frame / FRAMES)
            ax.fill(*outline.T, facecolor=(*shade[:3], 0.35), edgecolor=shade, lw=1)
        ax.plot(*moved.mean(1)[:, :2].T, color="0.3", lw=0.8)
        ax.axhline(0, color="0.6", lw=2)
        ax.set_aspect("equal")
        ax.axis("off")
        ax.set_title(name, fontsize=8)
    save(figure, "filming_motions.webp")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=["motions", "pictures"])
    if parser.parse_args().what == "motions":
        print("| motion | " + " | ".join(PROPERTIES) + " |")
        measure()
    else:
        for make in (draw_cameras, draw_exposure, draw_clocks, draw_motions):
            make()
