"""The memory that a stage is expected to take: what makes it more, and what is said where it does not fit."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
from ball import ball_scene

from masiv.config import load_config
from masiv.errors import InputError
from masiv.memory import available_bytes
from masiv.mpm.simulator import kernels_bytes
from masiv.pipeline.expected_memory import expected_memory, expected_tracks_memory
from masiv.pipeline.requests import Overrides, SceneRequest
from masiv.pipeline.tracks import TracksRun


def config(*assignments):
    return load_config("quick", assignments=("reconstruct.processes=1", "identify.processes=2", *assignments))


def expected(stage, *assignments, scene=None, particles=None):
    return expected_memory(stage, scene or ball_scene(), config(*assignments), particles).mb


@pytest.mark.parametrize(
    ("stage", "more"),
    [
        ("reconstruct", "reconstruct.processes=2"),
        ("identify", "trajectory.particle_count=6000"),
        ("identify", "identify.search_particles=4000"),
    ],
)
def test_a_setting_that_takes_more_is_expected_to(stage, more):
    assert expected(stage, more) > expected(stage) + 50


def test_refine_takes_less_in_one_process():
    assert expected("refine", "refine.processes=1") < expected("refine", "refine.processes=2") - 500


def test_more_particles_of_a_body_with_markers_take_more():
    few, many = (
        expected_tracks_memory("identify", config(f"tracks.particles={n}"), flights=False).mb for n in (1000, 5000)
    )
    assert many > few + 100
    flights = expected_tracks_memory("identify", config("tracks.particles=5000"), flights=True)
    assert flights.mb < few


def test_tracks_that_do_not_fit_are_refused_before_anything_is_made(tmp_path):
    scene, out = Path(__file__).parent / "golden" / "balls", tmp_path / "run"
    run = TracksRun.open(scene, out, Overrides(assignments=("memory_limit_mb=100",)), SceneRequest())
    with pytest.raises(InputError, match=r"identify would take about 0\.4 GB.*memory_limit_mb allows 0\.1 GB"):
        run.identify()
    assert not (out / "twin.yaml").exists()


@pytest.mark.parametrize("less", ["identify.processes=1", "simulator.memory_mb=300", "identify.law=neo_hookean"])
def test_a_setting_that_takes_less_is_expected_to(less):
    assert expected("identify", less) < expected("identify") - 300


def test_particles_of_the_trajectory_count_if_it_is_there():
    known = expected("identify", "trajectory.particle_count=8000", particles=1000)
    assert known == expected("identify", "trajectory.particle_count=1000")


def test_larger_pictures_take_more_up_to_what_is_kept_of_them():
    scene = dataclasses.replace(ball_scene(), frame_count=100)

    def with_pixels(factor):
        cameras = [dataclasses.replace(c, width=factor * c.width, height=factor * c.height) for c in scene.cameras]
        return expected("trajectory", scene=dataclasses.replace(scene, cameras=tuple(cameras)))

    small, large, larger = (with_pixels(factor) for factor in (1, 8, 16))
    assert small < large < larger
    all_pixels = 16**2 * scene.cameras[0].width * scene.cameras[0].height * scene.frame_count * len(scene.views)
    assert larger - small < 0.3 * all_pixels * 8 / 1e6


def test_a_stage_that_does_not_fit_says_what_to_change():
    memory = expected_memory("identify", ball_scene(), config())
    memory.require(0, lambda: memory.mb + 1)
    memory.require(round(memory.mb + 1), lambda: 0.0)
    with pytest.raises(InputError, match=r"machine has left 0\.1 GB") as refused:
        memory.require(0, lambda: 100.0)
    for name in ("identify would take about", "simulator.memory_mb", "identify.processes=1", "memory_limit_mb="):
        assert name in str(refused.value)
    with pytest.raises(InputError, match=r"memory_limit_mb allows 0\.2 GB"):
        memory.require(200, lambda: 1e6)


@pytest.mark.slow
def test_what_simulators_reserve_is_what_a_process_takes():
    particles, substeps, nodes, chunks = 5000, 256, 1 << 18, 2
    code = f"""
import torch
from masiv import runtime
from masiv.memory import taken_bytes
from masiv.mpm.simulator import Simulator
runtime.start_on_one_thread("cpu")
def reserved(count, substeps):
    before = taken_bytes()
    body = Simulator(particle_count=count, spacing=0.1, substep=1e-4, volume=1.0, density=1e3, gravity=(0, -9.8, 0),
                     max_substeps=substeps, grid_nodes={nodes}, chunks={chunks})
    body.kernels.allocate()
    return taken_bytes() - before
reserved(1000, 64)
print(reserved({particles}, {substeps}))
"""
    found = float(subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True).stdout.split()[-1])
    assert kernels_bytes(particles, 1500, substeps, nodes, chunks) == pytest.approx(found, rel=0.15)


@pytest.mark.parametrize(
    ("maximum", "used", "cache"),
    [
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ],
)
def test_the_limit_of_a_container_counts(tmp_path, maximum, used, cache):
    machine = available_bytes(tmp_path)
    assert machine > 0
    for name, text in ((maximum, "900000000\n"), (used, "500000000\n")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / maximum).with_name("memory.stat").write_text(f"anon 1\n{cache} 100000000\n")
    assert available_bytes(tmp_path) == 500_000_000  # the system takes cached files back
    (tmp_path / maximum).write_text("max\n")
    assert available_bytes(tmp_path) > 500_000_000
