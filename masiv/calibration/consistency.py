"""How well the silhouettes of each camera agree with those of the others, and which camera does not.

Nothing is reconstructed: the measure is the epipolar tangency error of pairs of cameras (``tangency``).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from masiv.calibration.tangency import Outline, outline, tangency_errors
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

MAX_RATIO = {3: 15.0, 4: 6.5, 5: 5.0}
MAX_RATIO_OF_MORE = 4.5
"""A camera stands out if its error is more than this times the error among the others, by the number of cameras.

99 % quantiles of the largest ratio over the cameras of rings with the same random errors on each camera, which
``python benchmarks/silhouette_consistency.py`` draws afresh: one calibration in a hundred is suspected wrongly."""
RESOLUTION = 0.35  # pixels
"""Error among cameras that are exactly calibrated, with masks of 0 and 1: the 99 % quantile of the same script. A
smaller one says nothing about the calibration."""
MIN_SUSPECT = 1.0  # pixels; a smaller error is within what a mask can say about the object's edge


@dataclass(frozen=True)
class Consistency:
    """Epipolar tangency errors between V cameras, over all frames.

    pairs (V, V) [pixels of the first camera]: RMS over the two tangents of the median over the frames; NaN if the two
    cameras never see a common tangent. pixels (V,): the median over the pairs of each camera, NaN if it has none.
    views: index of each of the V cameras in the scene. suspect: index in the scene of the camera that disagrees with
    the others, if one stands out; others [pixels]: the median over the pairs without it.
    """

    views: tuple[int, ...]
    pairs: np.ndarray
    pixels: np.ndarray
    suspect: int | None
    others: float


def silhouette_consistency(scene: Scene) -> Consistency:
    """The consistency of the cameras of ``scene`` that are not held out. Reads every picture."""
    cameras = [scene.cameras[view] for view in scene.views]
    by_frame = [scene.map_views(frame, lambda _, picture: outline(picture)) for frame in range(scene.frame_count)]
    outlines = [list(own) for own in zip(*by_frame, strict=True)]
    return consistency(scene.views, pair_errors(cameras, outlines))


def pair_errors(cameras: list[Camera], outlines: list[list[Outline | None]]) -> np.ndarray:
    """``Consistency.pairs`` of V cameras and their outlines, V lists over the same frames."""
    return pairs_of(tangency_series(cameras, outlines))


def tangency_series(cameras: list[Camera], outlines: list[list[Outline | None]]) -> np.ndarray:
    """``tangency_errors`` (V, V, F, 2) [pixels of the first camera] of all pairs at F frames; NaN if unknown."""
    count = len(cameras)
    series = np.full((count, count, len(outlines[0]) if outlines else 0, 2), np.nan)
    for i, camera in enumerate(cameras):
        for j, other in enumerate(cameras):
            if i == j:
                continue
            for frame, (mine, its) in enumerate(zip(outlines[i], outlines[j], strict=True)):
                if mine is not None and its is not None:
                    series[i, j, frame] = tangency_errors(camera, mine, other, its)
    return series


def pairs_of(series: np.ndarray) -> np.ndarray:
    """``Consistency.pairs`` of ``tangency_series``: RMS over the two tangents of the median over the frames.

    The calibration is the same in all frames: the median is not moved by a frame with a bad mask.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # all are NaN
        return np.sqrt(np.nanmean(np.nanmedian(np.abs(series), axis=2) ** 2, axis=2))


def consistency(views: tuple[int, ...], pairs: np.ndarray) -> Consistency:
    """What ``pairs`` (V, V) [pixels] say about the cameras ``views``."""
    count = len(views)
    pixels, among = np.full(count, np.nan), np.full(count, np.nan)
    for k in range(count):
        rest = np.delete(np.arange(count), k)
        pixels[k] = _median(np.concatenate([pairs[k, rest], pairs[rest, k]]))
        among[k] = _median(pairs[np.ix_(rest, rest)])
    ratio = pixels / np.maximum(among, RESOLUTION)
    suspect, others = None, _median(pairs)
    if np.isfinite(ratio).any():
        worst = int(np.nanargmax(ratio))
        if ratio[worst] > MAX_RATIO.get(count, MAX_RATIO_OF_MORE) and pixels[worst] > MIN_SUSPECT:
            suspect, others = views[worst], float(among[worst])
    return Consistency(views, pairs, pixels, suspect, others)


def odd_camera(scene: Scene, found: Consistency) -> str | None:
    """The sentence about a camera that stands out, if there is one."""
    if found.suspect is None:
        return None
    error = found.pixels[found.views.index(found.suspect)]
    return (
        f"view {found.suspect} ({scene.cameras[found.suspect].name}): its silhouettes disagree with those of the other "
        f"cameras by {error:.1f} px, the others among themselves by {found.others:.1f} px: check its pose, focal "
        "length, clock and masks"
    )


def _median(values: np.ndarray) -> float:
    """The median of those that are not NaN; NaN if all are."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
