"""The clips of the effects gallery: one an effect, small, and of the code as it is."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest

from masiv.effects.catalogue import causes

DOCS = Path(__file__).parents[1] / "docs"
MAX_BYTES = 150_000


@pytest.fixture(scope="module")
def gallery():
    specification = importlib.util.spec_from_file_location("gallery", DOCS / "gallery.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def kept(name: str) -> np.ndarray:
    """The pictures (T, H, W, 3) of a clip, BGR."""
    there, animation = cv2.imreadanimation(str(DOCS / f"gallery/{name}.webp"))
    assert there
    return np.stack([frame[..., :3] for frame in animation.frames])


def test_every_effect_has_a_clip(gallery):
    assert set(gallery.SHOWN) == set(causes()) == {path.stem for path in (DOCS / "gallery").iterdir()}


@pytest.mark.parametrize("name", sorted(causes()))
def test_a_clip_shows_that_the_effect_changes_the_motion(gallery, name):
    assert (DOCS / f"gallery/{name}.webp").stat().st_size <= MAX_BYTES
    frames = kept(name).astype(float)
    assert frames.shape[1:] == (gallery.HEIGHT, 2 * gallery.WIDTH + 4, 3)
    without, with_it = frames[:, :, : gallery.WIDTH], frames[:, :, -gallery.WIDTH :]
    different = (np.abs(without - with_it).max(3) > 40).mean((1, 2))
    assert different[0] < 0.01 if name not in ("time_offset", "ground_height") else True
    assert different.max() > 0.03  # the cube covers about 0.09 of the picture


@pytest.mark.slow
@pytest.mark.usefixtures("taichi")
def test_clips_are_of_the_present_code(gallery):
    name = "linear_drag"
    made = np.stack(gallery.clip(name))[..., ::-1].astype(float)
    assert np.abs(kept(name)[: len(made)] - made).mean() < 4  # grey levels; what compression loses


def test_the_cube_is_closed_and_faces_outwards(gallery):
    points, surface, faces = gallery.cube()
    corners = points[surface][faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    inner = gallery.EDGE * (1 - 1 / gallery.COUNT)
    assert volume == pytest.approx(inner**3)
