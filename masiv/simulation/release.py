"""Rollouts of a deformable body that is held at rest and then let go: a body with markers."""

from __future__ import annotations

import numpy as np
import torch

from masiv.errors import InputError, NonFiniteError
from masiv.models.marked_body import MarkedBody, placed_body
from masiv.progress import Progress, silent
from masiv.simulation.particle_fields import accelerates, fields_at, stacked
from masiv.simulation.rollout import Rollout
from masiv.simulation.twin_effects import effect_members
from masiv.twin import Twin


@torch.no_grad()
def simulate_release(
    twin: Twin, *, frames: int, fps: float, fields: bool = False, progress: Progress = silent
) -> Rollout:
    """``frames`` frames at k / fps [s] after the release of the only body of ``twin``. fields: also those of the
    particles. Raises InputError, NonFiniteError."""
    body, release = released_body(twin), twin.initial_conditions[0].release
    assert release is not None  # released_body raises otherwise
    if frames < 2:
        raise InputError(f"--frames {frames}: give at least 2")
    times = np.arange(frames) / fps
    last = min((motion.times[-1] for motion in release.motions if motion is not None), default=np.inf)
    if times[-1] > last + 1 / fps:
        known = int(last * fps) + 1
        raise InputError(f"--frames {frames}: the motion of a clamp is known for {known} frames: give as many at most")
    members = effect_members(twin, twin.body)
    effects = body.effects(members, body.context(float(times[-1]), 1 / fps))
    causes = [effect for effect, _ in members if accelerates(effect)]
    substep = body.substep(twin.law, times, effects)
    simulator = body.simulator(substep, body.contact, torch.float32)
    ends = [round(float(t) / substep) for t in times]
    state, at, positions, felt = body.at_start(simulator, twin.law, effects, torch.float32), 0, [], []
    acting = next((now for _, _, now in body.pieces(effects, 0, 1, substep)), effects)
    for frame, end in enumerate(ends):
        for begin, stop, acting in body.pieces(effects, at, end, substep):
            try:
                state = simulator.run(state, twin.law, stop - begin, [], acting, begin * substep).final
            except NonFiniteError as error:
                raise NonFiniteError(begin + error.substep, error.particle, error.detail) from error
        at = end
        positions.append(state.position)
        if fields:
            felt.append(fields_at(simulator, twin.law, state, acting, causes, at * substep, body.axes))
        if frame:
            progress("simulate", frame, frames - 1)
    moved = torch.stack(positions)
    world = body.axes.points_to_world(moved.double().numpy())
    return Rollout(
        world.astype(np.float32), times, body.markers_to_world(moved), tuple(release.markers),
        stacked(felt) if fields else None,
    )  # fmt: skip


def released_body(twin: Twin) -> MarkedBody:
    """The only body of ``twin`` at its place in the first observation. Raises InputError if that is not a release."""
    body, start = twin.body, twin.initial_conditions[0]
    if body.particles is None or body.particle_spacing is None or start.placement is None or start.release is None:
        raise InputError(f"body {body.name} needs particles and a placement in {start.observation} to be let go there")
    markers = start.release.markers
    if not markers:
        raise InputError(f"{start.observation}: no marker with all three axes moves with the material")
    return placed_body(
        body.particles,
        body.volume,
        body.density,
        twin.simulator,
        particle_spacing=body.particle_spacing,
        placement=start.placement,
        clamps=body.clamps,
        at_rest=np.array(list(markers.values())),
        markers=tuple(range(len(markers))),
        up=twin.up,
        gravity=twin.gravity,
        ground=twin.ground,
        contact=twin.contact,
        speed=start.release.max_speed,
        motions=start.release.motions,
    )
