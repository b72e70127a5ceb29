"""Masks of one frame that agree with each other: what several views say of a pixel counts.

Masks that were estimated from colours have two defects that no view can see alone: a part of the object that looks like
the background behind it is missing, and a shadow or a passer-by is included. The other views know the volume in
question.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from masiv.hull.carve import occupancy_grid
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.hull.votes import FEWEST_VIEWS, Votes, consensus, vote
from masiv.scene.frame_cache import Frame
from masiv.scene.scene import Scene

RESOLUTION = 36
_ROUNDS = 2
_LARGEST_HOLE = 0.15
"""A hole that is larger than this share of the mask is one of the object."""
_CLOSING = 0.15
"""Width of the mouth of a bay that counts as a hole, over the square root of the mask's area. A debt, as the sizes
above and below: set by hand on noisy pictures of three scenes."""
_COVERED = 0.9
"""Share of a hole that the hull of the other views covers, if it is a defect of the mask."""
_SUPPORT = 2.0
"""Confident views that deny all that a pixel may show, if it is not on the object."""
_CERTAIN = 0.95
"""Probability that a correction gives: the object where it fills, one minus this where it removes."""


def consistent_masks(scene: Scene, frame: int) -> dict[int, Frame]:
    """The pictures of ``frame`` in all views, with corrected masks.

    Holes and narrow bays of a mask are filled if the hull of the other views covers them. Pixels at which two other
    views or more deny every voxel are removed. Parts that are missing in one view and needed by two others are added.
    With fewer than five views the pictures are returned as they are.
    """
    pictures = {view: scene.frame(view, frame) for view in scene.views}
    given = {s.view: s for s in silhouettes(scene, frame)}
    shown = {view: p for view, p in pictures.items() if p.valid.any() and (p.mask > 0.5).any()}
    if len(shown) < FEWEST_VIEWS:
        return pictures
    masks = {view: p.mask for view, p in shown.items()}
    for _ in range(_ROUNDS):
        views = tuple(given[view].with_mask(mask) for view, mask in masks.items())
        grid = occupancy_grid(views, scene, frame, RESOLUTION)
        votes = vote(views, grid.points, 0.5 * grid.spacing, scene.ground, grid.spacing)
        hull = consensus(views, votes)
        masks = {view.view: _corrected(masks[view.view], view, k, votes, hull) for k, view in enumerate(views)}
    return {view: replace(p, mask=masks.get(view, p.mask)) for view, p in pictures.items()}


def _corrected(mask: np.ndarray, view: Silhouette, k: int, votes: Votes, hull: np.ndarray) -> np.ndarray:
    """``mask`` (H, W) of view number ``k``, corrected by the ``votes`` of the others."""
    side = votes.sides[k]
    cells, shown = votes.cells[:, k], votes.cells[:, k] >= 0
    against = votes.denied.sum(axis=1) - votes.denied[:, k]
    others = shown & votes.allowed & (against < 0.5)
    covered = _picture(view, side, cells[others])
    needed = _picture(view, side, cells[shown & hull & (votes.denied[:, k] > 0.5)])
    possible = _picture(view, side, cells[shown & votes.allowed & (against < _SUPPORT)])
    inside = mask > 0.5
    filled = _holes(inside, covered) | (needed & ~inside)
    margin = cv2.dilate(possible.astype(np.uint8), np.ones((2 * side + 1, 2 * side + 1), np.uint8)) > 0
    result = np.where(filled, np.maximum(mask, _CERTAIN), mask)
    return np.where(inside & ~margin & view.valid, np.minimum(result, 1 - _CERTAIN), result).astype(np.float32)


def _picture(view: Silhouette, side: int, cells: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) bool lie in one of the ``cells``."""
    height, width = view.distance.shape
    rows, columns = height // side + 1, width // side + 1
    flat = np.zeros(rows * columns, bool)
    flat[cells] = True
    return np.kron(flat.reshape(rows, columns), np.ones((side, side), bool))[:height, :width]


def _holes(mask: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Holes and bays of ``mask`` that are small and ``covered`` by the hull of the other views."""
    area = max(int(mask.sum()), 1)
    width = 2 * max(1, round(0.5 * _CLOSING * np.sqrt(area))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    solid = cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED)
    count, labels = cv2.connectedComponents(((solid > 0) & ~mask).astype(np.uint8), connectivity=4)
    filled = np.zeros(mask.shape, bool)
    for label in range(1, count):
        hole = labels == label
        if not cv2.erode(hole.astype(np.uint8), np.ones((3, 3), np.uint8)).any():
            continue  # a sliver that the closing cut off from the outside
        if hole.sum() <= _LARGEST_HOLE * area and covered[hole].mean() >= _COVERED:
            filled |= hole
    return filled
