"""How large are the errors of points that are followed in pictures? Synthetic scenes of random bodies, whose motion is
known.

    python benchmarks/tracking_error.py draw OUT --count 8
    masiv reconstruct OUT/NUMBER/scene --out OUT/NUMBER/run --preset quick
    masiv trajectory OUT/NUMBER/run --preset quick
    python benchmarks/tracking_error.py split OUT
    python benchmarks/tracking_error.py measure OUT

A folder of OUT may be another scene with its truth: OUT/NAME/scene and OUT/NAME/run. ``split`` compares two sets of
cameras of each (``refine.camera_split``); it takes twice the time of reconstruct. ``measure`` prints the error of the
last frames in each group of modes, and what two sets of cameras say of it; and, for each group of modes of motion, the
factor on the size that refine expects of smooth errors, before the body has touched anything and after: the posterior
mode under a prior that says next to nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

PRIOR_SD = 3.0
"""Standard deviation of the logarithm of the factors in their prior."""


def spec(seed: int):
    """A body of random shape, size, law and motion, 11 cameras."""
    from masiv.shapes import ShapeSpec
    from masiv.synth.spec import CameraSpec, MaterialSpec, SynthSpec

    rng = np.random.default_rng([seed, 20261129])
    law, parameters = _law(rng)
    velocity = rng.normal(0, 0.8, 3) * (1, 0.5, 1)
    frames, fps = 16, 24.0
    reach = -0.5 * velocity * frames / fps
    size = rng.uniform(0.3, 0.6)
    return SynthSpec(
        shape=ShapeSpec(
            kind=rng.choice(["cube", "sphere", "capsule", "cylinder", "torus", "cross"]), size=size,
            rotation_deg=tuple(rng.uniform(-180, 180, 3)), position=(reach[0], reach[2]),
            clearance=rng.uniform(0.1, 0.4),
        ),
        material=MaterialSpec(law=law, parameters=parameters),
        velocity=tuple(velocity), omega=tuple(rng.normal(0, 3, 3)),
        contact=rng.choice(["sticky", "slip"]), friction=rng.uniform(0.1, 0.6),
        texture=rng.choice(["noise", "stripes", "patches"]), image_noise=rng.uniform(0.5, 3),
        cameras=CameraSpec(size=160, target=(0, 0.35, 0)), frames=frames, fps=fps, seed=seed,
    )  # fmt: skip


def _law(rng: np.random.Generator) -> tuple[str, dict[str, float]]:
    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    kind = rng.choice(["neo_hookean", "von_mises", "newtonian", "drucker_prager"], p=[0.4, 0.25, 0.2, 0.15])
    if kind == "newtonian":
        return kind, {"viscosity": between(5, 200), "bulk_modulus": between(5e4, 3e5)}
    ratio = float(rng.uniform(0.2, 0.4))
    if kind == "neo_hookean":
        return kind, {"youngs_modulus": between(1e4, 3e5), "poissons_ratio": ratio}
    if kind == "von_mises":
        return kind, {"youngs_modulus": between(5e4, 5e5), "poissons_ratio": ratio, "yield_stress": between(1e3, 1e4)}
    return kind, {
        "youngs_modulus": between(1e5, 5e5), "poissons_ratio": ratio, "friction_angle": float(rng.uniform(20, 45)),
    }  # fmt: skip


def draw(out: Path, count: int, first: int) -> None:
    from masiv import runtime
    from masiv.synth.synthesise import synthesise

    runtime.start("cpu")
    for seed in range(first, first + count):
        if not (out / str(seed) / "scene").exists():
            (out / str(seed)).mkdir(parents=True, exist_ok=True)
            synthesise(spec(seed), out / str(seed) / "scene")
            print(f"{seed}: {spec(seed).material.law} {spec(seed).shape.kind} {spec(seed).texture}", flush=True)


def errors_of(run: Path, scene: Path):
    """times (T,) [s], positions (T, N, 3) [m] of followed particles at the frames, and their errors (T, N, 3) [m]."""
    from masiv.continuum.trajectory import Trajectory
    from masiv.metrics import true_displacements
    from masiv.subsample import kd_tree_subset

    trajectory = Trajectory.load(run / "trajectory.npz")
    seen = trajectory.positions[:, kd_tree_subset(trajectory.positions[0], 1500)].astype(np.float64)
    at = np.stack([np.load(scene / "gt" / f"particles_{k}.npy") for k in range(len(seen))]).astype(np.float64)
    true = np.stack(list(true_displacements(seen[0], at)))
    return trajectory.times, seen, seen - seen[0] - true


def sizes_of(run: Path, scene: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    """names: of G groups of modes. Factors (2 G,) on the expected size of smooth errors that are most probable, in
    flight and from the first contact on; what a group adds to the error after contact [mm] (G,)."""
    from dataclasses import replace

    from masiv.inference.marginal_likelihood import ParameterPriors, SizePriors, marginal
    from masiv.inference.segments import Segment
    from masiv.observations.base import Observation
    from masiv.observations.noise_floor import noise_floor
    from masiv.refinement.config import RefineConfig
    from masiv.rigid import beyond_rigid, first_contact_frame

    times, seen, error = errors_of(run, scene)
    noise = noise_floor(seen, first_contact_frame(beyond_rigid(seen)))
    lost = RefineConfig().tracking_error * beyond_rigid(seen)
    # Corrections of no size: instants after the first contact are a segment of their own, as in refine.
    none = np.zeros(seen[1:].shape)
    observation = Observation(
        name="", times=times[1:], points=seen[0], values=seen[1:], fit_count=len(times) - 1, noise_std=noise,
        residual_std=np.hypot(noise, np.maximum.accumulate(lost)), grid_corrections=(none, none),
    )  # fmt: skip
    segments = Segment.of(0, observation, error[1:])
    field = np.zeros((*error[1:].shape, 0))
    blocks = [b for s in segments for b in s.blocks(error[1:], field)]
    prior = SizePriors.of(blocks)
    count = len(prior.mean) // 3
    wide = replace(prior, sd=np.where(np.arange(len(prior.sd)) < 2 * count, PRIOR_SD, prior.sd))
    found = marginal(blocks, ParameterPriors(np.zeros(0), np.zeros((1, 0))), wide)
    names = list(segments[0].modes.names)
    late = [b for b in blocks if b.group >= len(names)] or blocks
    added = np.array([1e3 * np.sqrt((b.residual**2).sum(1).mean()) for b in late])
    factors = np.full(2 * len(names), np.nan)
    factors[:count] = found.sizes.smooth
    for g in set(range(count)) - {b.group for b in blocks}:
        factors[g] = np.nan
    return names, factors, added


LAST = 4
"""Frames over which errors are compared with the difference of two sets of cameras."""


def compare(run: Path, scene: Path) -> None:
    """Print root mean squares [mm] over the last frames: errors of all points, of the upper and the lower quarter of
    the body, of each group of modes; of half the difference of two sets of cameras; and what refine assumes."""
    from masiv.continuum.camera_split import CameraSplit
    from masiv.inference.motion_modes import MotionModes, rotations_since_start
    from masiv.refinement.config import RefineConfig
    from masiv.rigid import beyond_rigid
    from masiv.splat.dynamic import DynamicGaussians

    times, seen, error = errors_of(run, scene)
    modes, turned = MotionModes.of(seen[0], 3), rotations_since_start(seen[0], seen)

    def by_group(field: np.ndarray) -> str:
        parts = modes.coefficients(field, turned)
        sizes = [1e3 * np.sqrt((c[-LAST:] ** 2).sum(1).mean()) for c in parts]
        whole = 1e3 * np.sqrt((field[-LAST:] ** 2).sum(2).mean())
        return f"{whole:.1f} mm (" + ", ".join(f"{n} {s:.1f}" for n, s in zip(modes.names, sizes, strict=True)) + ")"

    height = seen[0][:, 1]
    low, high = (
        error[-LAST:, part] for part in (height < np.quantile(height, 0.25), height > np.quantile(height, 0.75))
    )
    print(f"{run.parent.name}: error {by_group(error)}; upper and lower quarter "
          f"{1e3 * np.sqrt((high**2).sum(2).mean()):.1f}, {1e3 * np.sqrt((low**2).sum(2).mean()):.1f} mm; "
          f"assumed {1e3 * RefineConfig().tracking_error * beyond_rigid(seen)[-LAST:].mean():.1f} mm")  # fmt: skip
    halves = [run / "camera_split" / str(k) for k in range(2)]
    if all(half.is_dir() for half in halves):
        first, second = map(DynamicGaussians.load, halves)
        print(f"{run.parent.name}: two sets {by_group(CameraSplit((first, second)).tracking_error(seen[0], times))}")


def split(out: Path) -> None:
    from masiv import runtime
    from masiv.pipeline import reopen_run
    from masiv.pipeline.stages import ensure_camera_split
    from masiv.pipeline.video import VideoRun
    from masiv.progress import silent
    from masiv.refinement.config import RefineConfig

    runtime.start("cpu")
    for folder in sorted(f for f in out.iterdir() if (f / "run" / "trajectory.npz").is_file()):
        run = reopen_run(folder / "run", require="trajectory")
        assert isinstance(run, VideoRun)
        config = run.config.model_copy(update={"refine": RefineConfig(camera_split=True)})
        ensure_camera_split(run.folder, config, run.given_scene, silent)
        print(f"{folder.name}: compared", flush=True)


def measure(out: Path) -> None:
    rows = []
    followed = (f for f in out.iterdir() if (f / "run" / "trajectory.npz").is_file())
    for folder in sorted(followed, key=lambda f: f.name):
        compare(folder / "run", folder / "scene")
        names, factors, added = sizes_of(folder / "run", folder / "scene")
        rows.append(np.log(factors))
        flight, contact = np.split(factors, 2)
        print(folder.name, "flight", np.round(flight, 2), "contact", np.round(contact, 2), "[mm]", np.round(added, 1))
    logs = np.array(rows)
    for regime, part in zip(("flight", "contact"), np.split(logs, 2, axis=1), strict=True):
        for name, values in zip(names, part.T, strict=True):
            print(f"{regime} {name}: factor {np.exp(np.nanmean(values)):.2f}, sd of its logarithm "
                  f"{np.nanstd(values, ddof=1):.2f}, {np.isfinite(values).sum()} scenes")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["draw", "split", "measure"])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    if given.what == "draw":
        draw(given.out, given.count, given.first)
    elif given.what == "split":
        split(given.out)
    else:
        measure(given.out)


if __name__ == "__main__":
    main()
