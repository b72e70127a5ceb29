"""Mirror planes of hulls: an ellipsoid and a body without symmetry, seen by few cameras on one side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring_scene import look_at, pixel_rays, spheres_scene
from scipy.spatial.transform import Rotation

from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import density_field
from masiv.continuum.trajectory import first_mirror
from masiv.errors import InputError
from masiv.hull.carve import visual_hull
from masiv.hull.silhouette import silhouettes
from masiv.hull.symmetry import MirrorPlane, contradicting, mirror_plane, overlap, symmetric_hull, uncovered
from masiv.scene.scene import Frame

CENTRE = np.array([0.05, 0.45, 0.0])
TURN = Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()
"""Columns: the axes of the bodies in the world."""
HALF_AXES = np.array([0.3, 0.22, 0.14])
CONFIG = TrajectoryConfig(fill_resolution=40)


def ellipsoid(origin, rays):
    """Which rays (H, W, 3) from ``origin`` hit the ellipsoid."""
    start, along = (origin - CENTRE) @ TURN / HALF_AXES, rays @ TURN / HALF_AXES
    return (along @ start) ** 2 >= (along**2).sum(axis=-1) * (start @ start - 1)


def corner(origin, rays):
    """Which rays (H, W, 3) from ``origin`` hit three rods of unequal length at right angles, which have no mirror."""
    start, along = (origin - CENTRE) @ TURN + 0.12, rays @ TURN
    hit = np.zeros(rays.shape[:2], bool)
    for axis, length in enumerate((0.5, 0.36, 0.22)):
        low, high = np.full(3, -0.06), np.full(3, 0.06)
        high[axis] = length
        with np.errstate(divide="ignore"):
            near, far = (low - start) / along, (high - start) / along
        hit |= np.minimum(near, far).max(axis=-1) <= np.maximum(near, far).min(axis=-1)
    return hit


def cameras(count=4):
    """Cameras on an arc of 100°."""
    angles = np.radians(np.linspace(0, 100, count))
    return tuple(
        look_at(str(k), CENTRE + np.array([2.5 * np.cos(a), 0.5, 2.5 * np.sin(a)]), CENTRE, 128, 300.0)
        for k, a in enumerate(angles)
    )


def filmed(body, probability=1.0):
    """The scene of ``body``; ``probability``: of the object where the mask shows it."""

    def load(view, frame):
        camera = known[view]
        mask = body(camera.centre, pixel_rays(camera)) * np.float32(probability)
        image = np.where(mask[..., None] > 0, 200, 60).astype(np.uint8) * np.ones(3, np.uint8)
        return Frame(image, mask.astype(np.float32), np.ones(mask.shape, bool))

    known = cameras()
    return replace(spheres_scene(lambda frame: [], cameras=known), load=load, ground=None)


TRUE_PLANES = [MirrorPlane(axis, float(axis @ CENTRE)) for axis in TURN.T]
VOLUME = 4 / 3 * np.pi * HALF_AXES.prod()


def test_mirrored_twice_is_the_same():
    points = np.random.default_rng(0).normal(size=(20, 3))
    plane = TRUE_PLANES[0]
    image = plane.mirrored(points)
    np.testing.assert_allclose((image + points) / 2 @ plane.normal, plane.offset)
    np.testing.assert_allclose(plane.mirrored(image), points)


@pytest.mark.parametrize("plane", TRUE_PLANES)
def test_a_true_plane_removes_phantom_volume_and_nothing_of_the_body(plane):
    scene = filmed(ellipsoid)
    hull = visual_hull(scene, 0, resolution=40)
    tighter = symmetric_hull(hull, plane)
    assert tighter.volume < hull.volume
    assert tighter.volume > VOLUME
    body = ((hull.points - CENTRE) @ TURN / HALF_AXES) ** 2
    kept = {tuple(p) for p in tighter.points.round(9)}
    assert all(tuple(p) in kept for p in hull.points[body.sum(axis=1) < 0.95].round(9))
    assert contradicting(silhouettes(scene, 0), hull, tighter) == []


def test_the_volume_error_falls_with_the_plane_given():
    scene = filmed(ellipsoid)
    before = density_field(scene, None, 0, CONFIG).volume
    errors = []
    for plane in TRUE_PLANES:
        config = TrajectoryConfig(fill_resolution=40, symmetry=tuple(plane.normal.tolist()))
        found = first_mirror(scene, config)
        assert found is not None
        assert abs(found.offset - plane.offset) < 0.02
        errors.append(density_field(scene, None, 0, config, mirror=found).volume / VOLUME - 1)
    assert all(-0.02 < error < before / VOLUME - 1 for error in errors)
    assert min(errors) < 0.7 * (before / VOLUME - 1)


def test_auto_finds_a_plane_that_the_silhouettes_allow():
    scene = filmed(ellipsoid)
    found = first_mirror(scene, TrajectoryConfig(fill_resolution=40, symmetry="auto"))
    assert found is not None
    hull = visual_hull(scene, 0, resolution=40)
    assert overlap(hull, found) > max(overlap(hull, plane) for plane in TRUE_PLANES) - 0.02
    assert symmetric_hull(hull, found).volume < hull.volume


def test_a_body_without_symmetry_stays_as_it_is():
    scene = filmed(corner)
    assert first_mirror(scene, TrajectoryConfig(fill_resolution=40, symmetry="auto")) is None
    for axis in np.eye(3):
        with pytest.raises(InputError, match=r"trajectory.symmetry: the masks of view \d at frame 0 contradict"):
            first_mirror(scene, TrajectoryConfig(fill_resolution=40, symmetry=tuple(axis)))


@pytest.mark.slow
def test_doubtful_masks_contradict_less():
    """Where masks are wrong by their own account as often as a plane needs it, they do not speak against it."""
    lost = {}
    for probability in (1.0, 0.6):
        scene = filmed(corner, probability)
        hull = visual_hull(scene, 0, resolution=40)
        tighter = symmetric_hull(hull, mirror_plane(hull))
        lost[probability] = uncovered(silhouettes(scene, 0), hull, tighter)
    for view in lost[1.0]:
        assert lost[1.0][view][1] == 0
        assert lost[0.6][view][1] > 0
        assert lost[0.6][view][0] <= lost[1.0][view][0]


def test_without_being_asked_for_there_is_no_plane():
    assert first_mirror(filmed(ellipsoid), CONFIG) is None
    with pytest.raises(ValueError, match="must not be zero"):
        TrajectoryConfig(symmetry=(0.0, 0.0, 0.0))
