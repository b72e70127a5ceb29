"""Fine-tune a motion network on filled volumes, keeping the identity of the material that the pictures gave it.

A Chamfer distance says where the object is, not which part of it went where. The terms beside it say that: the motion
of the surface that the pictures gave, smoothness, and little change of volume. Lengths are in particle spacings.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy import spatial

from masiv.checkpoint import Checkpoint
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import FilledVolume
from masiv.continuum.losses import below_ground, field_terms, load_views, outside_of_mask, stencil
from masiv.errors import MasivError
from masiv.progress import Progress
from masiv.scene.scene import Scene
from masiv.splat.deformation import DeformationNetwork

if TYPE_CHECKING:
    from masiv.splat.dynamic import DynamicGaussians

_STENCILS = 256
_ANCHORS = 768
_KNOWN_FRAMES = 4
_KNOWN_WEIGHT = 10.0
_VOLUME_SLACK = 1.1
"""A frame's filled volume may exceed that of frame 0 by this factor; more is a part of the hull that no camera sees."""


@dataclass(frozen=True)
class Known:
    """Motion of the first K frames that stays: displacements (K, Q, 3) [m] of the particles, and a ``network`` of all
    frames that has it, whose motion of the later ones is the first guess and the guide of the surface."""

    displacements: torch.Tensor
    network: DeformationNetwork


@dataclass(frozen=True)
class Matches:
    """Nearest-neighbour pairs of a Chamfer distance, gathered per particle: targets (T, Q, 3) [m], weights (T, Q)."""

    targets: torch.Tensor
    weights: torch.Tensor


def fine_tune(
    scene: Scene,
    dynamic: DynamicGaussians,
    start: FilledVolume,
    volumes: list[FilledVolume],
    config: TrajectoryConfig,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
    known: Known | None = None,
) -> DeformationNetwork:
    """A copy of the motion of ``dynamic`` that carries ``start`` into ``volumes``, one a frame after 0. Resumable.

    With ``known`` it begins as the network there, keeps the first frames' motion, and ``volumes`` are of the others.
    Raises MasivError where the loss becomes non-finite.
    """
    problem = _Problem(scene, dynamic, start, config, known)
    network = copy.deepcopy(dynamic.deformation if known is None else known.network).requires_grad_(True)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    first = 0
    state = checkpoint.load()
    if state is not None:
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        first = state["iteration"]

    for iteration in range(first, config.iterations):
        if iteration % config.match_every == 0:
            # States are kept here alone, since the matches are a function of the network at this moment.
            checkpoint.maybe_save(partial(_state, network, optimiser, iteration))
            with torch.no_grad():
                moved = problem.points + network.displacements(problem.points, problem.times)
            matches = match(moved.double().numpy(), volumes, start)
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * (0.02 + 0.49 * (1 + math.cos(math.pi * iteration / config.iterations)))
        losses = problem.losses(network, matches, np.random.default_rng([seed, iteration]))
        total = sum(_weight(config, name) * value for name, value in losses.items())
        if not torch.isfinite(total):
            raise MasivError(
                f"trajectory: the loss became non-finite at iteration {iteration}; lower trajectory.learning_rate"
            )
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        note = ", ".join(f"{name} {float(value.detach()):.3g}" for name, value in losses.items())
        progress("trajectory", iteration + 1, config.iterations, note)
    return network.requires_grad_(False)


class _Problem:
    """What does not change while the network is tuned."""

    def __init__(
        self,
        scene: Scene,
        dynamic: DynamicGaussians,
        start: FilledVolume,
        config: TrajectoryConfig,
        known: Known | None,
    ) -> None:
        self.config, self.spacing, self.ground, self.known = config, start.spacing, scene.ground, known
        self.points = torch.as_tensor(start.points, dtype=torch.float32)
        first = 1 if known is None else len(known.displacements)
        self.known_times = torch.as_tensor(scene.times[:first], dtype=torch.float32)
        self.times = torch.as_tensor(scene.times[first:], dtype=torch.float32)
        self.views = load_views(scene)[first:]
        opaque = dynamic.canonical.opacities.detach().reshape(-1) > 0.1
        self.anchors = dynamic.canonical.means.detach()[opaque]
        guide = dynamic.deformation if known is None else known.network
        with torch.no_grad():
            self.anchor_motion = guide.displacements(self.anchors, self.times)

    def losses(
        self, network: DeformationNetwork, matches: Matches, draw: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        """The terms, unweighted, of one step, on what ``draw`` picks."""
        count = len(self.points)
        batch = torch.as_tensor(draw.permutation(count)[: self.config.batch])
        anchors = torch.as_tensor(draw.permutation(len(self.anchors))[:_ANCHORS])
        step = 1.5 * self.spacing
        centres = self.points[torch.as_tensor(draw.permutation(count)[:_STENCILS])]
        asked = torch.cat([self.points[batch], self.anchors[anchors], stencil(centres, step)])
        moved, at_anchors, at_stencil = network.displacements(asked, self.times).split(
            [len(batch), len(anchors), 7 * len(centres)], dim=1
        )
        positions = self.points[batch] + moved
        square = 1 / self.spacing**2
        pull = (positions - matches.targets[:, batch]).square().sum(-1) * matches.weights[:, batch]
        outside = [
            outside_of_mask(at_frame, views[draw.integers(len(views))])
            for at_frame, views in zip(positions, self.views, strict=True)
        ]
        losses = {
            "chamfer": pull.sum() * (square * count / len(batch) / len(self.times)),
            "silhouette": torch.stack(outside).square().mean() * square,
            "motion": (at_anchors - self.anchor_motion[:, anchors]).square().sum(-1).mean() * square,
            **field_terms(at_stencil, step),
        }
        if self.ground is not None:
            losses["ground"] = below_ground(positions, self.ground).square().mean() * square
        if self.known is not None:
            frames = torch.as_tensor(draw.permutation(len(self.known_times))[:_KNOWN_FRAMES])
            off = network.displacements(self.points[batch], self.known_times[frames])
            off = off - self.known.displacements[frames[:, None], batch]
            losses["known"] = off.square().sum(-1).mean() * square
        return losses


def match(moved: np.ndarray, volumes: list[FilledVolume], start: FilledVolume) -> Matches:
    """Chamfer pairs between particles ``moved`` (T, Q, 3) [m] and the T ``volumes``.

    mean_i |x_i - v(x_i)|² + mean_j |v_j - x(v_j)|², pairs held, has the gradient of sum_i w_i |x_i - target_i|². Pairs
    nearer than the spacing tell only the two samplings apart: they do not pull. Volume beyond that of ``start`` by
    more than a tenth does not pull either, the farthest first: it is hull that no camera sees.
    """
    targets, weights = moved.copy(), np.zeros(moved.shape[:2])
    noise = 0.8 * start.spacing
    for t, volume in enumerate(volumes):
        count, filled = len(moved[t]), len(volume.points)
        away, nearest = spatial.cKDTree(volume.points).query(moved[t])
        back, owner = spatial.cKDTree(moved[t]).query(volume.points)
        share = np.where(back > noise, 1.0 / filled, 0.0)
        share[np.argsort(back, kind="stable")[int(_VOLUME_SLACK * start.volume / volume.spacing**3) :]] = 0.0
        weights[t] = np.where(away > noise, 1.0 / count, 0.0)
        weighted = weights[t][:, None] * volume.points[nearest]
        weights[t] += np.bincount(owner, share, count)
        for axis in range(3):
            weighted[:, axis] += np.bincount(owner, share * volume.points[:, axis], count)
        pulled = weights[t] > 0
        targets[t, pulled] = weighted[pulled] / weights[t, pulled, None]
    return Matches(torch.as_tensor(targets, dtype=torch.float32), torch.as_tensor(weights, dtype=torch.float32))


def _weight(config: TrajectoryConfig, term: str) -> float:
    return _KNOWN_WEIGHT if term == "known" else getattr(config, f"{term}_weight")


def _state(network: DeformationNetwork, optimiser: torch.optim.Optimizer, iteration: int) -> dict[str, Any]:
    return {"network": network.state_dict(), "optimiser": optimiser.state_dict(), "iteration": iteration}
