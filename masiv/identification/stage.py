"""The identify stage: from a trajectory to a twin.

MASIV, section "Material-Agnostic System Identification": the initial velocity from free flight, a starting law, then a
joint fit of law, velocity, spin and effective ground through the rollout.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.continuum.trajectory import Trajectory
from masiv.identification.adapter import fit_adapter
from masiv.identification.classical.identify import fit_classical_law
from masiv.identification.config import IdentifyConfig
from masiv.identification.losses.objective import Objective
from masiv.identification.neural.multi_start import fit_neural_law
from masiv.identification.recording import FitRecording, prepare_recording
from masiv.identification.result import IdentificationResult
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState
from masiv.mpm.config import SimulatorConfig
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.simulation.twin_effects import effect_members
from masiv.subsample import random_subset
from masiv.twin import Twin
from masiv.twin.twin import VOLUME_ERROR


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
    """The twin whose rollout follows ``trajectory``, the observed motion over the frames of ``scene``.

    A neural law (``config.law``) assumes nothing of the material: the pretrained law whose rollout is nearest to the
    motion is only its start. Any other law is a classical one, or an adapter on one. others: more recordings of the
    same object; a neural law is fitted to all of them.

    If ``config.processes`` allows several processes, ``scene`` must be picklable, and a script needs
    ``if __name__ == "__main__":`` around its calls. Raises InputError for ``others`` with a law that is not neural, and
    MasivError if no law explains the motion.
    """
    if others:
        config.require_neural_for_several()
    checkpoint = checkpoint or Checkpoint(None)
    with runtime.torch_threads(1):
        prepared = [prepare_recording(*one, config, simulator) for one in ((scene, trajectory), *others)]
        recordings = [recording for recording, _ in prepared]
        result = _fit(recordings, _coarse(scene, trajectory, recordings[0], seed), seed, checkpoint, progress)
    initial_motion = prepared[0][1]
    axes, initial_state = recordings[0].objective.problem.axes, result.initial_state
    return Twin.of_body(
        observation=scene.path.resolve().name,
        positions=np.asarray(trajectory.positions[0], dtype=np.float32),
        velocity=axes.vectors_to_world(initial_state.velocity.double().numpy()),
        omega=axes.vectors_to_world(initial_state.omega.double().numpy()),
        gravity=np.asarray(scene.gravity, dtype=np.float64),
        ground=initial_state.ground(scene.ground),
        contact=result.contact,
        volume=trajectory.volume,
        density=scene.density,
        up=np.asarray(scene.up, dtype=np.float64),
        fps=scene.fps,
        law=result.law,
        simulator=simulator,
        fit={
            **result.report,
            "trajectory_error_mm": 1e3 * result.trajectory_error,
            "initial_velocity_m_per_s": [float(v) for v in initial_motion.velocity],
            "initial_omega_rad_per_s": [float(v) for v in initial_motion.omega],
            "free_flight_last_frame": initial_motion.last_frame,
            "frames": scene.frame_count,
            **_volume_error(trajectory),
            "history": result.history,
        },
    )


def _volume_error(trajectory: Trajectory) -> dict[str, float]:
    error = float(trajectory.volume * trajectory.volume_log_sd)
    return {VOLUME_ERROR: error} if np.isfinite(error) else {}


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
    """``twin`` with a neural law, fitted to ``trajectory`` with the twin's effects, which do not change.

    The fit starts with the initial state of ``twin``. Raises MasivError if no law explains the motion.
    """
    known = effect_members(twin, twin.body)
    problem = FilmedBody(scene, trajectory, twin.simulator, samples=config.samples_per_frame, known=known)
    axes = problem.axes
    ground_offset = 0.0 if twin.ground is None or scene.ground is None else twin.ground.height - scene.ground.height
    initial_state = InitialState.of_world(axes, twin.velocity, twin.omega, ground_offset)
    recording = FitRecording(Objective.of(problem, trajectory, config), initial_state, (problem.frames + 1) // 2)
    coarse = _coarse(scene, trajectory, recording, seed)
    with runtime.torch_threads(1):
        result = fit_neural_law([recording], coarse, seed, checkpoint or Checkpoint(None), progress)
    fitted = result.initial_state
    velocity, omega = (axes.vectors_to_world(v.double().numpy()) for v in (fitted.velocity, fitted.omega))
    learned = twin.with_body(law=result.law).with_motion(velocity=velocity, omega=omega)
    learned = learned.with_boundary(ground=fitted.ground(scene.ground), contact=result.contact)
    errors = {"trajectory_error_mm": 1e3 * result.trajectory_error, "history": result.history}
    return replace(learned, fit={**twin.fit, **result.report, **errors})


def _coarse(scene: Scene, trajectory: Trajectory, recording: FitRecording, seed: int) -> Callable[[], Objective]:
    """Makes the objective of ``recording`` with few particles, and the same known effects."""
    config, whole = recording.objective.config, recording.objective.problem

    def make() -> Objective:
        chosen = random_subset(trajectory.positions.shape[1], config.search_particles, seed)
        problem = FilmedBody(
            scene, trajectory, whole.body.config, samples=config.samples_per_frame, chosen=chosen, known=whole.known
        )
        return Objective.of(problem, trajectory, config)

    return make


def _fit(
    recordings: Sequence[FitRecording],
    coarse: Callable[[], Objective],
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
) -> IdentificationResult:
    """The law of the kind that the configuration asks for."""
    config = recordings[0].objective.config
    if config.law == "neural":
        return fit_neural_law(recordings, coarse, seed, checkpoint, progress)
    kind = config.adapter_base if config.law == "adapter" else config.law
    fit, report = fit_classical_law(kind, recordings[0], coarse(), checkpoint, progress)
    if config.law == "adapter":
        return fit_adapter(fit, recordings[0], report, seed, checkpoint, progress)
    return IdentificationResult(fit.law, fit.initial_state, fit.contact, fit.error_m, report)
