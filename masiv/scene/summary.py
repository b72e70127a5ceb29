"""Summary of a scene for ``masiv inspect``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from masiv.scene.assemble import format_ranges
from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Scene

FULL = 0.6
"""Part of a picture from which on a mask covers suspiciously much."""


def conventions(scene: Scene) -> dict[str, Any]:
    """Layout, time, axes, gravity, ground, density and noise of depth of a scene, as plain values."""
    ground = None
    if scene.ground is not None:
        ground = {"normal": scene.ground.normal.tolist(), "height_m": float(scene.ground.height)}
    noise = scene.depth_noise
    depth = {} if noise is None else {"depth_noise": {"constant_m": noise.constant, "quadratic_1_m": noise.quadratic}}
    return {
        "layout": scene.layout,
        "fps": float(scene.fps),
        "frames": scene.frame_count,
        "views": len(scene.cameras),
        "up": scene.up.tolist(),
        "gravity_m_s2": scene.gravity.tolist(),
        "ground": ground,
        "density_kg_m3": float(scene.density),
        "mask_source": scene.mask_source,
        **depth,
        **_shutters(scene),
    }


def _shutters(scene: Scene) -> dict[str, Any]:
    """Exposure and readout times of the cameras [s], if there is one that is not zero."""
    shutters = [camera.shutter for camera in scene.cameras]
    if all(shutter.is_instant for shutter in shutters):
        return {}
    return {
        "exposure_time_s": [shutter.exposure_time for shutter in shutters],
        "readout_time_s": [shutter.readout_time for shutter in shutters],
    }


def _ignore(view: int, frame: int, picture: Frame) -> None:
    pass


def summarise(scene: Scene, look: Callable[[int, int, Frame], None] = _ignore) -> dict[str, Any]:
    """The content of ``masiv inspect``. Reads every picture; one without the object becomes a problem. look(view,
    frame, picture) is called with each, frame after frame: masks that agree over the views are made for one frame at a
    time, and a large recording does not stay in memory.

    What compares the cameras is not known here: ``consistency_px``, ``mask_agreement``, ``mask_doubt``, the
    time offsets and the frames that flicker.
    """
    if scene.load_cloud is not None:
        return _summarise_clouds(scene)
    coverage = np.zeros((len(scene.views), scene.frame_count))
    seen, cut = np.zeros(coverage.shape, bool), np.zeros(coverage.shape, bool)
    known: list[float] = []
    for frame in range(scene.frame_count):
        pictures = scene.map_views(frame, lambda _, picture: picture)
        for row, (view, picture) in enumerate(zip(scene.views, pictures, strict=True)):
            seen[row, frame] = picture.valid.any()
            coverage[row, frame] = picture.mask.mean()
            cut[row, frame] = _at_the_edge(picture.mask)
            if picture.depth is not None and coverage[row, frame] > 0:
                known.append(float((picture.depth[picture.mask > 0.5] > 0).mean()))
            look(view, frame, picture)
    problems = [*scene.problems, *_coverage_problems(scene, coverage, seen), *_cut_problems(cut)]
    of_views = dict(zip(scene.views, seen.sum(axis=1).tolist(), strict=True))
    cut_frames: dict[int, list[int]] = {v: np.flatnonzero(c).tolist() for v, c in zip(scene.views, cut, strict=True)}
    coverage = coverage[seen] if seen.any() else coverage
    return {
        "scene": str(scene.path),
        **conventions(scene),
        "duration_s": (scene.frame_count - 1) / scene.fps,
        "fit_frames": scene.fit_frames,
        "mask_coverage": {"mean": coverage.mean(), "min": coverage.min(), "max": coverage.max()},
        **({"depth_coverage": {"mean": float(np.mean(known)), "min": min(known)}} if known else {}),
        "cameras": [
            {
                "name": camera.name,
                "width_px": camera.width,
                "height_px": camera.height,
                "focal_px": [float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])],
                "principal_point_px": [float(camera.intrinsics[0, 2]), float(camera.intrinsics[1, 2])],
                "position_m": camera.centre.tolist(),
                "frames": of_views.get(view, 0),
                "consistency_px": None,
                "mask_agreement": None,
                "mask_doubt": None,
                "time_offset_ms": None,
                "time_offset_error_ms": None,
                "flickering_frames": [],
                "cut_frames": cut_frames.get(view, []),
            }
            for view, camera in enumerate(scene.cameras)
        ],
        "problems": problems,
    }


def _coverage_problems(scene: Scene, coverage: np.ndarray, seen: np.ndarray) -> list[str]:
    """A sentence for each mask that is empty or nearly full. coverage (V, F), seen (V, F) bool."""
    problems = []
    for row, view in enumerate(scene.views):
        for frame in range(scene.frame_count):
            share = coverage[row, frame]
            if seen[row, frame] and share == 0:
                problems.append(f"view {view} at frame {frame}: the mask is empty")
            elif share > FULL:
                problems.append(f"view {view} at frame {frame}: the mask covers {share:.0%} of the picture")
    return problems


def _at_the_edge(mask: np.ndarray) -> bool:
    """Whether the object in ``mask`` (H, W) goes on beyond the picture."""
    return any((edge > 0.5).any() for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))


def _cut_problems(cut: np.ndarray) -> list[str]:
    """A sentence if the edge of the picture cuts the object. cut (V, F) bool."""
    frames = np.flatnonzero(cut.any(axis=0))
    if not len(frames):
        return []
    most = int(cut.sum(axis=0).max())
    return [
        f"frames {format_ranges(frames.tolist())}: the edge of the picture cuts the object in up to {most} of "
        f"{len(cut)} views: what no two of them show is not measured; film from farther away, or leave these frames out"
    ]


def _summarise_clouds(scene: Scene) -> dict[str, Any]:
    counts = [len(scene.cloud(frame).points) for frame in range(scene.frame_count)]
    first = scene.cloud(0)
    return {
        "scene": str(scene.path),
        **conventions(scene),
        "duration_s": (scene.frame_count - 1) / scene.fps,
        "fit_frames": scene.fit_frames,
        "points": {"mean": float(np.mean(counts)), "min": min(counts), "max": max(counts)},
        "box_m": [first.points.min(axis=0).tolist(), first.points.max(axis=0).tolist()],
        "cameras": [],
        "problems": list(scene.problems),
    }


def as_text(summary: dict[str, Any]) -> str:
    """The result of ``summarise`` as text."""

    def numbers(values: list[float]) -> str:
        return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"

    ground = summary["ground"]
    plane = "none" if ground is None else f"normal {numbers(ground['normal'])}, height {ground['height_m']:.4g} m"
    lines = [
        f"{summary['scene']}: {summary['layout']} layout",
        f"frames   {summary['frames']} at {summary['fps']:.6g} fps, {summary['duration_s']:.3f} s",
        f"units    metres, seconds; up {numbers(summary['up'])}; gravity {numbers(summary['gravity_m_s2'])} m/s²",
        f"ground   {plane}",
        f"density  {summary['density_kg_m3']:.6g} kg/m³",
    ]
    if "points" in summary:
        points, (low, high) = summary["points"], summary["box_m"]
        lines += [
            f"points   {points['mean']:.0f} a frame ({points['min']} to {points['max']}); "
            f"frame 0 from {numbers(low)} to {numbers(high)} m"
        ]
    else:
        coverage = summary["mask_coverage"]
        lines += [
            f"masks    {summary['mask_source']}; cover {coverage['mean']:.1%} of a picture "
            f"({coverage['min']:.1%} to {coverage['max']:.1%})"
        ]
    if "depth_coverage" in summary:
        known, noise = summary["depth_coverage"], summary["depth_noise"]
        lines += [
            f"depth    known in {known['mean']:.1%} of the object's pixels ({known['min']:.1%} at least); standard "
            f"deviation {1e3 * noise['constant_m']:.3g} mm + {1e3 * noise['quadratic_1_m']:.3g} mm/m² z²"
        ]
    lines += [f"cameras  {summary['views']}"]
    for key, name in (("exposure_time_s", "exposure"), ("readout_time_s", "readout ")):
        if key in summary:
            lines.append(f"{name} " + ", ".join(f"{1e3 * time:.3g}" for time in summary[key]) + " ms")
    lines += [
        f"  {index:2d} {camera['name']:10s} {camera['width_px']}×{camera['height_px']}"
        f"  focal {camera['focal_px'][0]:.1f} px  at {numbers(camera['position_m'])} m"
        + ("" if camera["frames"] == summary["frames"] else f"  {camera['frames']} of {summary['frames']} frames")
        for index, camera in enumerate(summary["cameras"])
    ]
    lines += _agreement(summary["cameras"])
    lines += ["problems " + ("none" if not summary["problems"] else "")]
    lines += [f"  - {problem}" for problem in summary["problems"]]
    return "\n".join([*lines, f"picture  {summary['picture']}"])


def _agreement(cameras: list[dict[str, Any]]) -> list[str]:
    """One line for each measure of a camera against the others."""
    measures = (
        ("consistency_px", ".2f", "agreement of the silhouettes with those of the other cameras [px]"),
        ("mask_agreement", ".2f", "intersection over union of masks and the hull of all views"),
        ("mask_doubt", ".2f", "share of the masks that is wrong by their own probabilities"),
    )
    lines = []
    for key, form, title in measures:
        known = [f"{k}: {camera[key]:{form}}" for k, camera in enumerate(cameras) if camera[key] is not None]
        lines += [f"{title}  {', '.join(known)}"] if known else []
    offsets = [
        f"{k}: {camera['time_offset_ms']:.1f} ± {camera['time_offset_error_ms']:.1f}"
        for k, camera in enumerate(cameras)
        if camera["time_offset_ms"] is not None
    ]
    return lines + ([f"clocks against the median camera [ms]  {', '.join(offsets)}"] if offsets else [])
