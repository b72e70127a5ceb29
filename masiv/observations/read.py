"""Read an observation, whatever its layout: ``read_observation``, or ``read_scene`` for video only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from masiv.errors import InputError
from masiv.hull.consistent_masks import consistent_masks
from masiv.scene import (
    blender,
    nerfstudio,
    pacnerf,
    phystwin,
    point_clouds,
    springgaus_real,
    springgaus_synthetic,
)
from masiv.scene.layout import Layout
from masiv.scene.scene import Scene
from masiv.tracks import read as tracks
from masiv.tracks.tracks import Tracks

LAYOUTS: tuple[Layout[Scene | Tracks], ...] = (
    tracks.LAYOUT,
    pacnerf.LAYOUT,
    springgaus_synthetic.LAYOUT,
    springgaus_real.LAYOUT,
    nerfstudio.LAYOUT,
    blender.LAYOUT,
    phystwin.LAYOUT,
    point_clouds.LAYOUT,
)
"""All layouts, in the order in which they are tried."""


def read_observation(path: str | Path) -> Scene | Tracks:
    """Read the video or the tracks at ``path``, with the ``scene.yaml`` next to the data.

    Raises InputError if no layout is recognized or the data cannot be used. Lesser defects are in ``problems``.

    Example:
        >>> read_observation("scenes/beam").layout  # doctest: +SKIP
        'tracks'
    """
    path = Path(path)
    for layout in LAYOUTS:
        if layout.can_read(path):
            found = layout.read(path)
            return found if isinstance(found, Tracks) else _with_consistent_masks(found)
    if not path.is_dir():
        raise InputError(f"{path} is not a folder: give the folder of a scene")
    known = "; ".join(f"{layout.files} ({layout.name})" for layout in LAYOUTS)
    raise InputError(f"{path} has no known scene layout: looked for {known}")


def _with_consistent_masks(scene: Scene) -> Scene:
    """Masks that are estimated from colours are made consistent over the views. Given ones are not changed."""
    return replace(scene, correct_masks=consistent_masks) if scene.masks_estimated else scene


def read_scene(path: str | Path) -> Scene:
    """Read the video at ``path``. Raises InputError as ``read_observation`` does, and for a scene of tracks."""
    if tracks.LAYOUT.can_read(Path(path)):
        raise InputError(f"{path} is a scene of tracks: this needs one of pictures")
    scene = read_observation(path)
    assert isinstance(scene, Scene)
    return scene
