"""Masks by background subtraction on drawn pictures whose true mask is known."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest

from masiv.scene.background import alpha_matte, learn_background
from masiv.scene.markov import smooth_labels

SIZE = 120


def floor(rng: np.random.Generator) -> np.ndarray:
    texture = cv2.GaussianBlur(rng.normal(0, 1, (SIZE, SIZE)).astype(np.float32), (0, 0), 6)
    return np.clip(150 + 60 * texture[..., None] * np.array([1.0, 1.0, 0.95]), 0, 255).astype(np.float32)


def disc(centre: tuple[float, float], radius: float) -> np.ndarray:
    """Coverage (H, W) in [0, 1] of each pixel, by 8 x 8 samples."""
    axis = (np.arange(8 * SIZE) + 0.5) / 8
    x, y = np.meshgrid(axis, axis)
    inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
    return inside.reshape(SIZE, 8, SIZE, 8).mean(axis=(1, 3))


def recording(rng: np.random.Generator, *, noise: float = 4.0, jpeg: int | None = 60, gain: float = 1.0):
    """Pictures (T, H, W, 3), the plate, true coverages (T, H, W): a textured disc that moves, with a soft shadow."""
    empty = floor(rng)
    patches = rng.uniform(40, 230, (5, 5, 3))
    pictures, covers = [], []
    for step in range(5):
        centre = (35 + 10 * step, 40 + 8 * step)
        cover = disc(centre, 17)
        shadow = cv2.GaussianBlur(disc((centre[0] + 14, centre[1] + 22), 15).astype(np.float32), (0, 0), 2)
        scene = empty * (1 - 0.35 * shadow[..., None] * np.array([1.05, 1.0, 0.95]))
        y, x = np.mgrid[:SIZE, :SIZE]
        texture = patches[(y - int(centre[1])) // 8 % 5, (x - int(centre[0])) // 8 % 5]
        scene = gain * (scene * (1 - cover[..., None]) + texture * cover[..., None])
        pictures.append(photograph(rng, scene, noise, jpeg))
        covers.append(cover)
    return np.stack(pictures), photograph(rng, empty, noise, jpeg), np.stack(covers)


def photograph(rng: np.random.Generator, scene: np.ndarray, noise: float, jpeg: int | None) -> np.ndarray:
    picture = np.clip(scene + rng.normal(0, noise, scene.shape), 0, 255).astype(np.uint8)
    if jpeg is None:
        return picture
    return cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, jpeg])[1], cv2.IMREAD_COLOR)


def overlap(mask: np.ndarray, cover: np.ndarray) -> float:
    one, other = mask > 0.5, cover > 0.5
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_jpeg_and_a_shadow(seed):
    pictures, plate, covers = recording(np.random.default_rng(seed))
    model = learn_background({0: pictures}, {0: plate})
    found = [overlap(model.mask(0, picture), cover) for picture, cover in zip(pictures, covers, strict=True)]
    assert min(found) > 0.8
    assert np.mean(found) > 0.87


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_small_plain_object_darker_than_the_scene_is_no_shadow(seed):
    """A grey ball in front of a bright wall: one color, a thousandth of the picture, shaded like a shadow would be."""
    rng, side = np.random.default_rng(seed), 360
    wall = np.broadcast_to(np.linspace(190, 215, side)[:, None, None] * [0.83, 0.9, 1.0], (side, side, 3))
    y, x = np.mgrid[:side, :side]
    pictures, covers = [], []
    for step in range(5):
        across, down = (x - 80 - 50 * step) / 12, (y - 150 - 6 * step**2) / 12
        cover = across**2 + down**2 < 1
        light = 0.6 + 0.4 * np.sqrt(np.maximum(1 - across**2 - down**2, 0)) * (1 - 0.5 * down) / 1.5
        ball = light[..., None] * rng.normal(1, 0.03, 3) * [118, 112, 108]
        pictures.append(photograph(rng, np.where(cover[..., None], ball, wall), 2.0, 80))
        covers.append(cover)
    model = learn_background({0: np.stack(pictures)}, {0: photograph(rng, wall, 2.0, 80)})
    found = [overlap(model.mask(0, picture), cover) for picture, cover in zip(pictures, covers, strict=True)]
    assert min(found) > 0.85


def test_light_that_changes_is_no_object():
    rng = np.random.default_rng(3)
    pictures, plate, covers = recording(rng, gain=0.85)
    model = learn_background({0: pictures}, {0: plate})
    assert overlap(model.mask(0, pictures[0]), covers[0]) > 0.85
    empty = photograph(rng, 0.85 * plate.astype(np.float32), 4.0, 60)
    assert (model.mask(0, empty) > 0.5).mean() < 0.01


@pytest.mark.slow
def test_large_pictures_take_little_memory_and_keep_their_outlines():
    """1200 x 960 pixels: learning takes a few float copies of the pictures at most, and a window finds the object."""
    rng = np.random.default_rng(6)
    pictures, plate, covers = recording(rng, noise=0.0, jpeg=None)
    large = [photograph(rng, enlarged(picture), 2.0, 80) for picture in pictures]
    images, plates = {view: large for view in range(4)}, {view: enlarged(plate).astype(np.uint8) for view in range(4)}
    tracemalloc.start()
    model = learn_background(images, plates)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    floats = 4 * sum(image.size for own in images.values() for image in own)
    assert peak < 3 * floats
    for image, cover in zip(large, covers, strict=True):
        assert overlap(model.mask(0, image), enlarged(cover)) > 0.95
    assert not model.mask(0, plates[0]).any()


def enlarged(picture: np.ndarray) -> np.ndarray:
    large = cv2.resize(picture.astype(np.float32), (960, 960), interpolation=cv2.INTER_LINEAR)
    return cv2.copyMakeBorder(large, 0, 0, 120, 120, cv2.BORDER_REPLICATE)


def test_probabilities_are_calibrated_within_the_outline():
    """Of the pixels with a probability near p, about the share p is on the object."""
    rng = np.random.default_rng(4)
    pictures, plate, covers = recording(rng)
    model = learn_background({0: pictures}, {0: plate})
    masks = np.stack([model.mask(0, picture) for picture in pictures])
    for low, high in ((0.0, 0.2), (0.2, 0.8), (0.8, 1.01)):
        chosen = (masks >= low) & (masks < high) & (masks > 1e-3)
        assert low - 0.1 < covers[chosen].mean() < high + 0.1


def test_clean_pictures_have_outlines_to_a_fraction_of_a_pixel():
    pictures, plate, covers = recording(np.random.default_rng(5), noise=1.0, jpeg=None)
    model = learn_background({0: pictures}, {0: plate})
    for picture, cover in zip(pictures, covers, strict=True):
        area = model.mask(0, picture).sum()
        # One hundredth of the radius would be 2 % of the area; the shadow is as large as the object.
        assert area == pytest.approx(cover.sum(), rel=0.08)


def test_alpha_matte_is_the_share_of_the_object():
    """A vertical edge at x = 60.3 between two plain colours, from labels that are wrong by a pixel."""
    share = np.clip(np.arange(SIZE) + 1 - 60.3, 0, 1)[None].repeat(SIZE, axis=0)
    colour, empty = np.array([200.0, 60.0, 40.0]), np.full((SIZE, SIZE, 3), 120.0, np.float32)
    picture = (share[..., None] * colour + (1 - share[..., None]) * empty).astype(np.float32)
    labels = np.zeros((SIZE, SIZE), np.float32)
    labels[:, 60:] = 1
    found = alpha_matte(labels, picture, empty, 1.0)
    np.testing.assert_allclose(found[10:-10, 58:63], share[10:-10, 58:63], atol=0.02)


def test_smooth_labels_removes_specks_and_keeps_edges():
    rng = np.random.default_rng(6)
    truth = np.zeros((60, 60), np.float32)
    truth[:, 30:] = 1
    image = np.where(truth[..., None] > 0, 200.0, 80.0).astype(np.float32).repeat(3, axis=2)
    log_odds = (2 * truth - 1 + rng.normal(0, 1.5, truth.shape)).astype(np.float32)
    found = smooth_labels(log_odds, image)
    assert ((log_odds > 0) != (truth > 0)).mean() > 0.2
    assert ((found > 0.5) != (truth > 0)).mean() < 0.005
