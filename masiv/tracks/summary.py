"""Summary and plot of tracks for ``masiv inspect``. Light: no torch, no taichi."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from masiv.files import atomic
from masiv.tracks.rest import find_rest
from masiv.tracks.tracks import Run, Tracks

_PATHS = 3000
"""Points of a marker's path that a picture can show."""


def summarise_tracks(tracks: Tracks) -> dict[str, Any]:
    """Everything that ``masiv inspect`` says, each number with its unit in its name."""
    ground = tracks.ground
    return {
        "scene": str(tracks.path),
        "layout": tracks.layout,
        "up": tracks.up.tolist(),
        "gravity_m_s2": tracks.gravity.tolist(),
        "ground": None if ground is None else {"normal": ground.normal.tolist(), "height_m": float(ground.height)},
        "bodies": [
            {
                "name": body.name,
                "group": body.group,
                "geometry": None if body.geometry is None else body.geometry.kind,
                "size_m": None if body.geometry is None else (body.geometry.upper - body.geometry.lower).tolist(),
                "volume_m3": None if body.geometry is None else body.geometry.volume,
                "density_kg_m3": body.density,
                "mass_kg": body.mass,
                "poissons_ratio": body.poissons_ratio,
                "clamp_markers": list(body.held_markers) if body.clamps else None,
            }
            for body in tracks.bodies.values()
        ],
        "runs": [_run(run) for run in tracks.runs],
        "problems": list(tracks.problems),
    }


def gaps(run: Run) -> dict[str, Any]:
    """Frames without a marker: their share, the longest gap [s], and that share by marker."""
    missing = ~run.seen
    longest = 0
    for column in missing.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], column, [False]]).astype(int)))
        longest = max(longest, int(np.diff(edges)[::2].max(initial=0)))
    shares = missing.mean(axis=0)
    return {
        "share": float(shares.mean()),
        "longest_frames": longest,
        "longest_s": longest / run.rate,
        "by_marker": dict(zip(run.markers, shares.tolist(), strict=True)),
    }


def _run(run: Run) -> dict[str, Any]:
    noise = run.noise_std
    found = find_rest(run.times, run.positions) if run.rest is None and run.release is None else None
    measured = "".join(axis for axis, known in zip("xyz", np.asarray(run.axes.any(axis=0)), strict=True) if known)
    return {
        "name": run.name,
        "body": run.body,
        "use": run.purpose,
        "condition": run.condition,
        "markers": list(run.markers),
        "axes": measured,
        "frames": len(run.times),
        "rate_hz": run.rate,
        "start_s": float(run.times[0]),
        "duration_s": float(run.times[-1] - run.times[0]),
        "release_s": run.release,
        "proposed_rest_frames": None if found is None else [found[0].start, found[0].stop],
        "proposed_release_s": None if found is None else found[1],
        "travel_mm": 1e3 * _travel(run),
        "noise_mm": None if noise is None else 1e3 * float(np.sqrt(np.nanmean(noise**2))),
        "placement_error_mm": None if run.placement is None else 1e3 * run.placement.error,
        "gaps": gaps(run),
    }


def _travel(run: Run) -> float:
    """How far [m] the marker that moves most gets from its rest."""
    off = np.nan_to_num(run.positions - run.at_rest)
    return float(np.sqrt((off**2).sum(axis=2)).max())


def tracks_as_text(summary: dict[str, Any]) -> str:
    """The result of ``summarise_tracks`` as text."""

    def numbers(values: list[float], scale: float = 1.0) -> str:
        return "(" + ", ".join(f"{scale * value:.4g}" for value in values) + ")"

    def known(value: float | None, unit: str, scale: float = 1.0) -> str:
        return "unknown" if value is None else f"{scale * value:.4g} {unit}"

    def distance(mm: float) -> str:
        return f"{mm:.4g} mm" if mm < 1e3 else f"{mm / 1e3:.4g} m"

    ground = summary["ground"]
    plane = "none" if ground is None else f"normal {numbers(ground['normal'])}, height {ground['height_m']:.4g} m"
    lines = [
        f"{summary['scene']}: tracks",
        f"units    metres, seconds; up {numbers(summary['up'])}; gravity {numbers(summary['gravity_m_s2'])} m/s²",
        f"ground   {plane}",
        f"bodies   {len(summary['bodies'])}",
    ]
    for body in summary["bodies"]:
        shape = "no geometry" if body["geometry"] is None else f"{body['geometry']} {numbers(body['size_m'], 1e3)} mm"
        lines.append(
            f"  {body['name']:16s} {shape}; volume {known(body['volume_m3'], 'cm³', 1e6)}; "
            f"mass {known(body['mass_kg'], 'g', 1e3)}; density {known(body['density_kg_m3'], 'kg/m³')}"
            + ("" if body["poissons_ratio"] is None else f"; Poisson's ratio {body['poissons_ratio']:.4g}")
            + (
                ""
                if body["clamp_markers"] is None
                else f"; clamped ({', '.join(body['clamp_markers']) or 'no marker'})"
            )
            + ("" if body["group"] == body["name"] else f"; group {body['group']}")
        )
    lines.append(f"runs     {len(summary['runs'])}")
    for run in summary["runs"]:
        gap = run["gaps"]
        missing = "no gaps" if gap["share"] == 0 else f"gaps {gap['share']:.1%}, longest {gap['longest_s']:.3g} s"
        lines.append(
            f"  {run['name']:16s} {run['use'].replace('_', ' ')}; {run['frames']} frames at {run['rate_hz']:.5g} Hz, "
            f"{run['duration_s']:.3g} s; {len(run['markers'])} markers ({run['axes']}), {missing}; "
            f"travel {distance(run['travel_mm'])}"
            + ("" if run["noise_mm"] is None else f"; noise {run['noise_mm']:.2g} mm")
            + ("" if run["release_s"] is None else f"; released at {run['release_s']:.4g} s")
            + (
                ""
                if run["proposed_rest_frames"] is None
                else f"; rests until {run['proposed_release_s']:.4g} s: rest_frames: {run['proposed_rest_frames']}"
            )
            + ("" if not run["placement_error_mm"] else f"; placed within {run['placement_error_mm']:.2g} mm")
            + (f"; {run['condition']}" if run["condition"] else "")
        )
    lines.append("problems " + ("none" if not summary["problems"] else ""))
    lines += [f"  - {problem}" for problem in summary["problems"]]
    return "\n".join([*lines, f"picture  {summary['picture']}"])


def write_tracks_picture(tracks: Tracks, path: Path) -> None:
    """Write a PNG: the geometry with the markers' paths from its two sides (where two axes were measured), and the
    markers' distance from rest over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    first = tracks.runs[0]
    figure, panels = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    for panel, (a, b) in zip(panels[:2], _views(tracks.up), strict=True):
        _draw_geometry(panel, tracks, first, a, b)
        for m, marker in enumerate(first.markers):
            points = first.positions[:: max(1, len(first.times) // _PATHS), m]
            panel.plot(points[:, a], points[:, b], lw=0.8, color=f"C{m % 10}", label=marker)
            panel.plot(*points[np.argmax(np.isfinite(points).all(axis=1))][[a, b]], "o", ms=4, color=f"C{m % 10}")
        panel.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]", title=first.name, aspect="equal")
    panels[0].legend(fontsize=7)
    for run in tracks.runs:
        off = run.positions - run.at_rest
        far = 1e3 * np.sqrt(np.nansum(off**2, axis=2)).max(axis=1)
        panels[2].plot(run.times, far, lw=0.8, label=f"{run.name} ({run.purpose.replace('_', ' ')})")
        if run.release is not None:
            panels[2].axvline(run.release, lw=0.5, color="0.6")
    panels[2].set(xlabel="time [s]", ylabel="farthest marker from rest [mm]", title="all runs")
    panels[2].legend(fontsize=6)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)


def _views(up: np.ndarray) -> list[tuple[int, int]]:
    """Two pairs of axes (across, up)."""
    vertical = int(np.abs(up).argmax())
    return [(axis, vertical) for axis in range(3) if axis != vertical]


def _draw_geometry(panel, tracks: Tracks, run: Run, a: int, b: int) -> None:
    from matplotlib.collections import PolyCollection

    geometry = tracks.bodies[run.body].geometry
    if geometry is None or run.placement is None:
        return
    corners = run.placement.to_world(geometry.vertices)[geometry.faces][:, :, [a, b]]
    panel.add_collection(PolyCollection(list(corners), facecolor="0.8", edgecolor="0.65", lw=0.2, alpha=0.5))
    panel.autoscale_view()
