"""Axes and time: hand cases and round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from masiv.errors import InputError
from masiv.scene.scene import Ground
from masiv.scene.transforms import SimulationFrame, frame_of_time, opengl_c2w_to_world_to_camera, time_of_frame

coordinate = st.floats(-10, 10, allow_nan=False)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
axis = vector.filter(lambda v: np.linalg.norm(v) > 1e-2)


@pytest.mark.parametrize("fps", [24.0, 30.0, 120.0, 1 / 0.03])
def test_every_frame_is_found_again_even_in_float32(fps):
    for k in range(2000):
        assert frame_of_time(time_of_frame(k, fps), fps) == k
        assert frame_of_time(np.float32(k) / np.float32(fps), fps) == k


def test_opengl_pose_keeps_t_x_and_turns_t_y_and_t_z():
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    np.testing.assert_allclose(opengl_c2w_to_world_to_camera(pose)[:3, 3], [-1, 2, 3])
    np.testing.assert_allclose(opengl_c2w_to_world_to_camera(pose[:3]) @ [1, 2, 1, 1], [0, 0, 2, 1])  # in front: +z


@settings(max_examples=100, deadline=None)
@given(up=axis, height=coordinate, points=st.lists(vector, min_size=1, max_size=5).map(np.array))
def test_simulation_frame_round_trip(up, height, points):
    ground = Ground(up / np.linalg.norm(up), height)
    frame = SimulationFrame.from_scene(up, ground)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)
    np.testing.assert_allclose(frame.points_to_world(frame.points_to_simulation(points)), points, atol=1e-8)
    np.testing.assert_allclose(frame.vectors_to_world(frame.vectors_to_simulation(points)), points, atol=1e-8)
    heights = points @ ground.normal - height
    np.testing.assert_allclose(frame.points_to_simulation(points)[:, 1], heights, atol=1e-8)


@pytest.mark.parametrize("up", [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 1e-7]])
def test_up_goes_to_y(up):
    frame = SimulationFrame.from_scene(np.array(up, float), None)
    unit = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(frame.vectors_to_simulation(unit), [0, 1, 0], atol=1e-6)
    assert np.linalg.det(frame.rotation) == pytest.approx(1)


def test_y_up_keeps_the_world_and_its_float_type():
    frame = SimulationFrame.from_scene(np.array([0.0, 1, 0]), Ground(np.array([0.0, 1, 0]), 0.25))
    points = np.array([[1.0, 2, 3]], np.float32)
    moved = frame.points_to_simulation(points)
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(moved, [[1, 1.75, 3]])


def test_a_zero_up_axis_is_refused():
    with pytest.raises(InputError, match="direction"):
        SimulationFrame.from_scene(np.zeros(3), None)
