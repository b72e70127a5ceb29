"""The identify stage: trajectory -> launch -> start -> joint fit -> twin."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.continuum.trajectory import Trajectory
from masiv.identify.baseline import identify_classical
from masiv.identify.config import IdentifyConfig
from masiv.identify.fit import fit, fit_from, fit_state
from masiv.identify.found import Found, history_rows
from masiv.identify.launch import estimate_launch
from masiv.identify.polish import polish, wanted
from masiv.identify.problem import Motion, Problem
from masiv.identify.start import Start, choose_start
from masiv.materials.neural import NeuralLaw
from masiv.mpm.config import SimulatorConfig
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.twin import Twin
from masiv.workers import Workers, processes_wanted


def identify(
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Twin:
    """The twin of what ``trajectory`` (over the frames of ``scene``) shows. Raises MasivError where no law explains it.

    With ``config.law`` neural nothing is assumed of the material: the pretrained law whose rollout is nearest to the
    motion is only the start. Otherwise the law is a classical one, or an adapter on one.

    Where ``config.processes`` lets several processes look for that start, ``scene`` must be picklable, and a script
    needs ``if __name__ == "__main__":`` around what it does.
    """
    with runtime.torch_threads(1):
        return _identify(scene, trajectory, config, simulator, seed, checkpoint or Checkpoint(None), progress)


def _identify(
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Twin:
    problem = Problem(scene, trajectory, config, simulator)
    launch = estimate_launch(
        trajectory.positions, trajectory.times, scene.gravity, scene.ground, clearance=problem.spacing
    )
    axes = problem.axes
    motion = Motion.of_world(axes, launch.velocity, launch.omega)
    first_frames = min(launch.last_frame + 2, problem.frames)
    few = functools.partial(Problem, scene, trajectory, config, simulator, particles=config.search_particles, seed=seed)
    if config.law == "neural":
        found = _neural(problem, few, motion, first_frames, seed, checkpoint, progress)
    else:
        found = identify_classical(problem, few(), motion, first_frames, seed, checkpoint, progress)
    return Twin(
        positions=np.asarray(trajectory.positions[0], dtype=np.float32),
        velocity=axes.vectors_to_world(found.motion.velocity.double().numpy()),
        omega=axes.vectors_to_world(found.motion.omega.double().numpy()),
        gravity=np.asarray(scene.gravity, dtype=np.float64),
        ground=found.motion.ground(scene.ground),
        contact=found.contact,
        friction=0.0,
        volume=trajectory.volume,
        density=scene.density,
        up=np.asarray(scene.up, dtype=np.float64),
        fps=scene.fps,
        law=found.law,
        simulator=simulator,
        fit={
            **found.report,
            "trajectory_error_mm": 1e3 * found.error_m,
            "launch_velocity_m_per_s": [float(v) for v in launch.velocity],
            "launch_omega_rad_per_s": [float(v) for v in launch.omega],
            "launch_last_frame": launch.last_frame,
            "frames": scene.frame_count,
            "history": found.history,
        },
    )


def relearn(
    twin: Twin,
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Twin:
    """``twin`` with a neural law that is learnt beside its effects, which stay as they are, from its throw on.

    Raises MasivError where no law explains ``trajectory``.
    """
    made = functools.partial(Problem, scene, trajectory, config, twin.simulator, known=twin.effects)
    problem, few = made(), functools.partial(made, particles=config.search_particles, seed=seed)
    axes = problem.axes
    raised = 0.0 if twin.ground is None or scene.ground is None else twin.ground.height - scene.ground.height
    motion = Motion.of_world(axes, twin.velocity, twin.omega, raised)
    with runtime.torch_threads(1):
        found = _neural(problem, few, motion, (problem.frames + 1) // 2, seed, checkpoint or Checkpoint(None), progress)
    return replace(
        twin,
        velocity=axes.vectors_to_world(found.motion.velocity.double().numpy()),
        omega=axes.vectors_to_world(found.motion.omega.double().numpy()),
        ground=found.motion.ground(scene.ground),
        contact=found.contact,
        law=found.law,
        fit={**twin.fit, **found.report, "trajectory_error_mm": 1e3 * found.error_m, "history": found.history},
    )


def _neural(
    problem: Problem,
    few: Callable[[], Problem],
    motion: Motion,
    first_frames: int,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Found:
    saved = checkpoint.load() or {}
    if "start" in saved:
        start = _start_from(saved["start"])
    else:
        with Workers(processes_wanted(problem.config.processes), "identify.processes") as workers:
            start = choose_start(few(), motion, progress, workers)[0]
    fixed: dict[str, Any] = {"start": _start_state(start)}
    keeper = _With(checkpoint, fixed)
    keeper.save({**saved})
    if "paths" in saved:
        fitted = fit_from(saved["paths"], NeuralLaw(width=start.law.width))
    else:
        fitted = fit(
            problem, start.law, motion, start.contact, first_frames, seed=seed, checkpoint=keeper, progress=progress
        )
    report: dict[str, Any] = {"start": start.material, "geometry_loss": problem.config.geometry_loss}
    if wanted(problem):
        keeper = _With(checkpoint, {**fixed, "paths": fit_state(fitted)})
        if "paths" not in saved:
            keeper.save({})
        fitted, seen = polish(
            problem, fitted, start.contact, start.law, seed=seed, checkpoint=keeper, progress=progress
        )  # fmt: skip
        report |= seen
    report["start_objective"] = start.error
    return Found(fitted.law, fitted.motion, start.contact, fitted.error_m, report, history_rows(fitted))


class _With(Checkpoint):
    """A checkpoint whose every state also holds ``fixed``."""

    def __init__(self, checkpoint: Checkpoint, fixed: dict) -> None:
        super().__init__(checkpoint.path, checkpoint.every_s)
        self.fixed = fixed

    def save(self, state: dict) -> None:
        super().save({**state, **self.fixed})


def _start_state(start: Start) -> dict:
    return {
        "material": start.material,
        "contact": start.contact,
        "error": start.error,
        "width": start.law.width,
        "law": start.law.state_dict(),
    }


def _start_from(state: dict) -> Start:
    law = NeuralLaw(width=state["width"])
    law.load_state_dict(state["law"])
    return Start(state["material"], state["contact"], law, state["error"])
