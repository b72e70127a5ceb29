"""The identify stage: trajectory -> launch -> start -> joint fit -> twin."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.continuum.trajectory import Trajectory
from masiv.identify.baseline import identify_classical
from masiv.identify.config import IdentifyConfig
from masiv.identify.learn import learn
from masiv.identify.problem import Problem
from masiv.identify.throw import Throw, throw_of
from masiv.models.initial_state import InitialState
from masiv.mpm.config import SimulatorConfig
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.simulation.twin_effects import effect_members
from masiv.subsample import random_subset
from masiv.twin import Twin


def identify(
    scene: Scene,
    trajectory: Trajectory,
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    *,
    others: Sequence[tuple[Scene, Trajectory]] = (),
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Twin:
    """The twin of what ``trajectory`` (over the frames of ``scene``) shows. Raises MasivError where no law explains it.

    With ``config.law`` neural nothing is assumed of the material: the pretrained law whose rollout is nearest to the
    motion is only the start. Otherwise the law is a classical one, or an adapter on one. others: more throws of the
    same object, from which a neural law is learnt, too; raises InputError for any other law.

    Where ``config.processes`` lets several processes look for that start, ``scene`` must be picklable, and a script
    needs ``if __name__ == "__main__":`` around what it does.
    """
    if others:
        config.refuse_more_throws()
    with runtime.torch_threads(1):
        seen = [(scene, trajectory), *others]
        return _identify(seen, config, simulator, seed, checkpoint or Checkpoint(None), progress)


def _identify(
    seen: Sequence[tuple[Scene, Trajectory]],
    config: IdentifyConfig,
    simulator: SimulatorConfig,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> Twin:
    scene, trajectory = seen[0]
    throws, initial_motions = zip(*(throw_of(*one, config, simulator) for one in seen), strict=True)
    first, initial_motion, axes = throws[0], initial_motions[0], throws[0].problem.axes
    chosen = random_subset(trajectory.positions.shape[1], config.search_particles, seed)
    coarse = functools.partial(Problem, scene, trajectory, config, simulator, chosen=chosen)
    if config.law == "neural":
        found = learn(throws, coarse, seed, checkpoint, progress)
    else:
        found = identify_classical(
            first.problem, coarse(), first.motion, first.first_frames, seed, checkpoint, progress
        )  # fmt: skip
    return Twin.of_body(
        observation=scene.path.resolve().name,
        positions=np.asarray(trajectory.positions[0], dtype=np.float32),
        velocity=axes.vectors_to_world(found.motion.velocity.double().numpy()),
        omega=axes.vectors_to_world(found.motion.omega.double().numpy()),
        gravity=np.asarray(scene.gravity, dtype=np.float64),
        ground=found.motion.ground(scene.ground),
        contact=found.contact,
        volume=trajectory.volume,
        density=scene.density,
        up=np.asarray(scene.up, dtype=np.float64),
        fps=scene.fps,
        law=found.law,
        simulator=simulator,
        fit={
            **found.report,
            "trajectory_error_mm": 1e3 * found.error_m,
            "launch_velocity_m_per_s": [float(v) for v in initial_motion.velocity],
            "launch_omega_rad_per_s": [float(v) for v in initial_motion.omega],
            "launch_last_frame": initial_motion.last_frame,
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
    made = functools.partial(Problem, scene, trajectory, config, twin.simulator, known=effect_members(twin, twin.body))
    chosen = random_subset(trajectory.positions.shape[1], config.search_particles, seed)
    problem, coarse = made(), functools.partial(made, chosen=chosen)
    axes = problem.axes
    raised = 0.0 if twin.ground is None or scene.ground is None else twin.ground.height - scene.ground.height
    motion = InitialState.of_world(axes, twin.velocity, twin.omega, raised)
    with runtime.torch_threads(1):
        throw = Throw(problem, motion, (problem.frames + 1) // 2)
        found = learn([throw], coarse, seed, checkpoint or Checkpoint(None), progress)
    velocity, omega = (axes.vectors_to_world(v.double().numpy()) for v in (found.motion.velocity, found.motion.omega))
    learned = twin.with_body(law=found.law).with_motion(velocity=velocity, omega=omega)
    learned = learned.with_boundary(ground=found.motion.ground(scene.ground), contact=found.contact)
    errors = {"trajectory_error_mm": 1e3 * found.error_m, "history": found.history}
    return replace(learned, fit={**twin.fit, **found.report, **errors})
