from __future__ import annotations

import numpy as np
import pytest
from ring_scene import ring, spheres_scene
from scipy.spatial import cKDTree
from still import still

from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import DensityField, density_field, depth_in_front, even_points, fill_volume
from masiv.errors import MasivError
from masiv.hull.volume import VolumePrior

CENTRE, RADIUS = np.array([0.05, 0.45, 0.0]), 0.25
CONFIG = TrajectoryConfig(particle_count=1500, fill_resolution=40)


def sphere_points(count: int, radius: float) -> np.ndarray:
    """Evenly spread points on a sphere around CENTRE (Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return CENTRE + radius * np.stack(
        [np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], axis=1
    )


def test_even_points_are_evenly_spread_and_stand_for_the_volume():
    field = DensityField(np.ones((20, 20, 20), np.float32), np.zeros(3), 0.05)
    spacing = 0.08
    points = even_points(field, spacing)
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    np.testing.assert_allclose(distance, 3**0.5 / 2 * 2 ** (1 / 3) * spacing, rtol=1e-9)
    assert len(points) * spacing**3 == pytest.approx(0.95**3, rel=0.1)


def test_sphere_is_filled_to_its_volume():
    # Rings of eight cameras leave facets, so many views are needed to come near the ball.
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(16))
    filled = fill_volume(scene, None, 0, CONFIG)
    assert filled.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.12)
    assert filled.volume == pytest.approx(len(filled.points) * filled.spacing**3, rel=1e-12)
    assert abs(len(filled.points) - CONFIG.particle_count) < 0.12 * CONFIG.particle_count
    assert np.linalg.norm(filled.points - CENTRE, axis=1).max() < 1.25 * RADIUS
    # solid, not a shell: as dense in the middle as anywhere
    middle = (np.linalg.norm(filled.points - CENTRE, axis=1) < 0.5 * RADIUS).sum() * filled.spacing**3
    assert middle == pytest.approx(4 / 3 * np.pi * (0.5 * RADIUS) ** 3, rel=0.08)


def test_particles_stand_for_the_volume_of_the_field():
    """The field falls through one half at its surface, also between the last voxel inside and the first one outside."""
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=ring(16))
    field = density_field(scene, None, 0, CONFIG)
    points = even_points(field, 0.4 * field.spacing)
    assert len(points) * (0.4 * field.spacing) ** 3 == pytest.approx(field.volume, rel=0.02)


def test_given_spacing_is_used():
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)])
    assert fill_volume(scene, None, 0, CONFIG, spacing=0.05).spacing == 0.05


def test_dust_is_dropped_and_two_bodies_stay():
    big = [(np.array([-0.3, 0.5, 0.0]), 0.2), (np.array([0.3, 0.5, 0.0]), 0.2)]
    dust = [(np.array([0.0, 0.9, 0.0]), 0.04)]
    points = fill_volume(spheres_scene(lambda frame: big + dust), None, 0, CONFIG).points
    assert (points[:, 0] < -0.1).any()
    assert (points[:, 0] > 0.1).any()
    assert (np.linalg.norm(points - dust[0][0], axis=1) > 0.1).all()


def test_too_few_particles_for_a_thin_body_is_an_error():
    scene = spheres_scene(lambda frame: [(CENTRE, 0.05)])
    with pytest.raises(MasivError, match="particle_count"):
        fill_volume(scene, None, 0, CONFIG, spacing=0.5)


def test_a_body_that_spread_to_a_thin_layer_is_filled():
    """A disc of 0.56 m, 35 mm thick, is one coarse voxel thick, which the mean filter removes."""
    along = np.arange(-0.255, 0.26, 0.03)
    centres = np.stack(np.meshgrid(along, [0.4], along), -1).reshape(-1, 3)
    disc = centres[np.hypot(centres[:, 0], centres[:, 2]) < 0.27]
    scene = spheres_scene(lambda frame: [(centre, 0.0175) for centre in disc], cameras=ring(16, size=160))
    config = CONFIG.model_copy(update={"fill_resolution": 16})
    volume = np.pi * 0.28**2 * 0.035
    assert density_field(scene, None, 0, config).volume < 0.5 * volume
    field = density_field(scene, None, 0, config, prior=VolumePrior(volume, 0.2))
    assert 0.8 * volume < field.volume < 1.5 * volume


def test_rendered_surface_carves_what_silhouettes_cannot_see(taichi):
    """Masks of a ball of RADIUS, rendered surface of a ball of 0.7 RADIUS: the shell between is seen to be empty."""
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)])
    dynamic = still(sphere_points(1500, 0.7 * RADIUS), 0.012)
    shell, core = sphere_points(300, 0.97 * RADIUS), sphere_points(300, 0.6 * RADIUS)
    facing = shell[np.abs(shell[:, 1] - CENTRE[1] - 0.05) < 0.3 * RADIUS]
    cameras = [scene.cameras[view] for view in scene.views]
    assert (depth_in_front(dynamic, cameras, 0.0, facing) > 0.01).mean() > 0.7
    assert not (depth_in_front(dynamic, cameras, 0.0, core) > 0.01).any()
    hull, carved = fill_volume(scene, None, 0, CONFIG), fill_volume(scene, dynamic, 0, CONFIG)
    assert carved.volume < 0.85 * hull.volume
    assert carved.volume > (0.7 * RADIUS) ** 3 * 4 / 3 * np.pi * 0.95
