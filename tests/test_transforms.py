"""Axes and time: hand cases and round trips."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from masiv.errors import InputError
from masiv.scene.scene import Ground
from masiv.scene.transforms import (
    SimulationFrame,
    TimeGrid,
    frame_of_time,
    opengl_c2w_to_world_to_camera,
    rotation_vector_to_world_to_camera,
)

coordinate = st.floats(-10, 10, allow_nan=False)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
axis = vector.filter(lambda v: np.linalg.norm(v) > 1e-2)


@pytest.mark.parametrize("fps", [24.0, 30.0, 120.0, 1 / 0.03])
def test_every_frame_is_found_again_even_in_float32(fps):
    for k in range(2000):
        assert frame_of_time(k / fps, fps) == k
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


@pytest.mark.parametrize(
    "up", [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 1e-7], [1e-5, -1, 0], [0.01, -1, 0.01]]
)
def test_up_goes_to_y(up):
    frame = SimulationFrame.from_scene(np.array(up, float), None)
    unit = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(frame.vectors_to_simulation(unit), [0, 1, 0], atol=1e-11)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-11)
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


def rotation_about(axis, angle):
    """Rodrigues' formula, in float64."""
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


@settings(max_examples=100, deadline=None)
@given(axis=axis, angle=st.floats(-3.1, 3.1), eye=vector, point=vector)
def test_opengl_pose_there_and_back(axis, angle, eye, point):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_about(axis, angle), eye
    to_camera = opengl_c2w_to_world_to_camera(pose)
    in_camera = to_camera[:3, :3] @ point + to_camera[:3, 3]
    back = pose[:3, :3] @ (in_camera * [1, -1, -1]) + eye  # OpenCV's y and z point the other way
    np.testing.assert_allclose(back, point, atol=1e-8)
    assert np.linalg.det(to_camera[:3, :3]) == pytest.approx(1)


@settings(max_examples=100, deadline=None)
@given(axis=axis, angle=st.floats(-3.1, 3.1), eye=vector, point=vector)
def test_rotation_vector_and_opengl_pose_agree(axis, angle, eye, point):
    """The same camera given in OpenCV's and in OpenGL's way sees the same."""
    rotation = rotation_about(axis, angle)
    vector = angle * axis / np.linalg.norm(axis)
    to_camera = rotation_vector_to_world_to_camera(vector, -rotation @ eye)
    np.testing.assert_allclose(to_camera[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(to_camera[:3, :3] @ eye + to_camera[:3, 3], 0, atol=1e-8)
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = rotation.T @ np.diag([1.0, -1, -1]), eye
    np.testing.assert_allclose(opengl_c2w_to_world_to_camera(c2w), to_camera, atol=1e-8)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), count=st.integers(2, 40), fps=st.floats(1, 500), views=st.integers(1, 4), start=st.floats(0, 5))
def test_even_times_are_found_whatever_the_order_and_the_jitter(data, count, fps, views, start):
    frames = np.tile(np.arange(count), views)
    jitter = data.draw(st.lists(st.floats(-0.003, 0.003), min_size=len(frames), max_size=len(frames)))
    order = data.draw(st.permutations(range(len(frames))))
    times = (start + (frames + np.array(jitter)) / fps)[order]
    grid = TimeGrid.from_times(list(times), [f"p{k}" for k in order])
    assert grid.count == count
    assert grid.fps == pytest.approx(fps, rel=0.008)
    assert [grid.frame(t) for t in times] == frames[order].tolist()
    assert grid.frame(times.min() - 1 / fps) is None
    assert grid.frame(times.min() + 0.5 / fps) is None


@settings(max_examples=100, deadline=None)
@given(count=st.integers(4, 30), fps=st.floats(1, 500), late=st.floats(0.03, 0.9), data=st.data())
def test_an_uneven_time_is_refused_and_named(count, fps, late, data):
    which = data.draw(st.integers(1, count - 1))
    times = np.arange(count) / fps
    times[which] += late / fps
    with pytest.raises(InputError, match=r"p\d+ has time|no view has a picture at frame") as error:
        TimeGrid.from_times(list(times), [f"p{k}" for k in range(count)])
    assert any(f"p{k} " in str(error.value) for k in (which, which + 1))


def test_fps_snaps_to_a_whole_number_and_a_declared_one_decides():
    names = [str(k) for k in range(8)]
    assert TimeGrid.from_times([round(k / 24, 5) for k in range(8)], names).fps == 24
    assert TimeGrid.from_times([0.03 * k for k in range(8)], names).fps == pytest.approx(1 / 0.03)
    rounded = [round(k / 30, 2) for k in range(8)]
    with pytest.raises(InputError, match=r"give fps in scene\.yaml"):
        TimeGrid.from_times(rounded, names)
    assert TimeGrid.from_times(rounded, names, fps=30.0).fps == 30


def test_a_frame_that_nobody_saw_is_named():
    with pytest.raises(InputError, match="at frame 3, between c and d"):
        TimeGrid.from_times([0, 0.1, 0.2, 0.4, 0.5], list("abcde"))
