"""Masks that are wrong in single frames: flicker.

The outline of a frame is compared with those of the other cameras at the same frame by epipolar tangency
(``tangency``), which needs no smooth motion: an impact is no jump. The constant part of the error is the calibration's.
A hole does not move the outline: it is off in one mask and well inside of those before and after.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np

from masiv.scene.assemble import format_ranges
from masiv.scene.scene import Scene

MAX_OUTLINE_RATIO, MAX_OUTLINE_RATIO_OF_THREE = 5.0, 8.0
"""An outline jumps if its error is more than this times the usual one of all pictures of the recording. The
largest of 120 recordings of 4 to 11 cameras without a fault was 4.8, of 40 with three cameras 5.8
(``benchmarks/inspect_calibration.py``) …"""
MIN_OUTLINE_PX = 1.0
"""… and more than a mask can say about the object's edge."""
MIN_HOLE = 0.02
"""Share of a mask; chosen: a smaller hole is below the resolution of most hulls."""
MAX_HOLE_RATIO = 4.0
"""Times the median of the other views, which see a true hole that moves past."""
EDGE_PX = 2
"""Well inside: the motion between frames is not straight, so that edges differ by about a pixel."""
QUANTILE = 0.75
"""Of the errors against the other cameras, over cameras and tangents. A mask that is wrong at one end has a wrong
tangent in half of them; one wrong mask among others concerns one pair of many."""
MAX_SHARE = 1 / 3
"""Of the frames. What is wrong more often is no flicker, but a calibration or a clock."""
FEWEST_FRAMES = 5
"""With fewer, the usual error is not known."""
FEWEST_VIEWS = 3
"""Two cameras do not say which of them is wrong."""


@dataclass(frozen=True)
class Flicker:
    """Of V views and F frames, NaN where unknown: outline (V, F) [pixels], by how much the tangents of a picture are
    off against the other cameras, less the constant part; holes (V, F): ``hole_share``. frames: of each view, those
    that flicker."""

    views: tuple[int, ...]
    outline: np.ndarray
    holes: np.ndarray
    frames: tuple[tuple[int, ...], ...]


def flicker(views: tuple[int, ...], series: np.ndarray, holes: np.ndarray) -> Flicker:
    """series (V, V, F, 2) [pixels]: ``consistency.tangency_series``; holes (V, F): ``hole_share``, NaN if unknown."""
    known = series.copy()
    found: list[set[int]] = [set() for _ in views]
    outline = _outline_errors(known)
    if series.shape[2] >= FEWEST_FRAMES and len(views) >= FEWEST_VIEWS:
        limit = MAX_OUTLINE_RATIO if len(views) > FEWEST_VIEWS else MAX_OUTLINE_RATIO_OF_THREE
        for view, frame in np.argwhere(np.nan_to_num(holes) > MIN_HOLE):
            if holes[view, frame] > MAX_HOLE_RATIO * _median(np.delete(holes[:, frame], view)):
                found[view].add(int(frame))
        now = outline
        while True:
            # The worst is taken out before the next is looked for: its errors are those of its partners as well.
            ratio = np.nan_to_num(now) / max(_median(now), MIN_OUTLINE_PX / limit)
            view, frame = np.unravel_index(int(ratio.argmax()), ratio.shape)
            if not ratio[view, frame] > limit:
                break
            found[view].add(int(frame))
            known[view, :, frame] = known[:, view, frame] = np.nan
            now = _outline_errors(known)
    few = [frames if len(frames) <= MAX_SHARE * series.shape[2] else set() for frames in found]
    return Flicker(views, outline, holes, tuple(tuple(sorted(frames)) for frames in few))


def hole_share(before: np.ndarray, mask: np.ndarray, after: np.ndarray) -> float:
    """Share of ``mask`` (H, W) that is missing in holes that it encloses, where the masks ``before`` and ``after`` are
    full, beyond the holes that these two have, as a ring does; NaN if it is empty."""
    area = int((mask > 0.5).sum())
    if area == 0:
        return float("nan")
    full = ((before > 0.5) & (after > 0.5)).astype(np.uint8)
    inside = cv2.erode(full, np.ones((2 * EDGE_PX + 1,) * 2, np.uint8))
    enclosed = _enclosed(mask)
    usual = max(int(_enclosed(before).sum()), int(_enclosed(after).sum()))
    return max(0, min(int((inside & enclosed).sum()), int(enclosed.sum()) - usual) / area)


def _enclosed(mask: np.ndarray) -> np.ndarray:
    """What is off in ``mask`` (H, W) and inside of its outer contours, uint8."""
    on = (mask > 0.5).astype(np.uint8)
    outer, _ = cv2.findContours(on, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(on)
    cv2.drawContours(filled, outer, -1, 1, cv2.FILLED)
    return filled & (1 - on)


def flickering_masks(scene: Scene, found: Flicker, but: Collection[int | None]) -> list[str]:
    """A sentence for each view of ``scene`` whose masks flicker; none for the views ``but``, which are wrong always."""
    said = []
    for row, (view, frames) in enumerate(zip(found.views, found.frames, strict=True)):
        if not frames or view in but:
            continue
        outline = float(np.nan_to_num(found.outline[row, list(frames)]).max())
        hole = float(np.nan_to_num(found.holes[row, list(frames)]).max())
        parts = [f"its outline is off by up to {outline:.1f} px"] if outline > MIN_OUTLINE_PX else []
        parts += [f"up to {hole:.0%} are missing inside"] if hole > MIN_HOLE else []
        said.append(
            f"view {view} ({scene.cameras[view].name}): its mask flickers at frame {format_ranges(list(frames))} "
            f"({', '.join(parts)}): correct these masks, or remove the pictures of these frames"
        )
    return said


def _outline_errors(series: np.ndarray) -> np.ndarray:
    """(V, F) [pixels] from (V, V, F, 2)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # all are NaN
        off = np.abs(series - np.nanmedian(series, axis=2, keepdims=True))
        both = np.concatenate([off, off.transpose(1, 0, 2, 3)], axis=1)
        return np.nanquantile(both.transpose(0, 2, 1, 3).reshape(len(series), series.shape[2], -1), QUANTILE, axis=2)


def _median(values: np.ndarray) -> float:
    known = np.asarray(values)[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
