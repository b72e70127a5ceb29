"""Fine-tune a deformation network to filled volumes without losing the correspondence that ``reconstruct`` found.

A Chamfer distance constrains the shape of the object, not the correspondence of its points. Further terms constrain
that: the surface motion of ``reconstruct``, smoothness, and small changes of volume. Lengths are in particle spacings.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

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
from masiv.splat.dynamic import DynamicGaussians

_STENCILS = 256
_ANCHORS = 768
_KNOWN_FRAMES = 4
"""Stencils, Gaussians and known frames that one step evaluates."""
_KNOWN_WEIGHT = 10.0
_MAX_VOLUME_RATIO = 1.1
"""Filled volume of a frame over that of frame 0. What exceeds it is shadow volume of the hull, which no camera sees."""


@dataclass(frozen=True)
class KnownMotion:
    """Motion of the first K frames that must not change.

    displacements (K, Q, 3) [m] of the particles. network: has that motion, and a first estimate of the later frames.
    """

    displacements: torch.Tensor
    network: DeformationNetwork


@dataclass(frozen=True)
class ChamferTargets:
    """Nearest-neighbour pairs of a Chamfer distance, summed for each particle: targets (T, Q, 3) [m], weights (T, Q).

    sum_i w_i |x_i - target_i|² has the gradient of the Chamfer distance with its pairs held fixed.
    """

    targets: torch.Tensor
    weights: torch.Tensor


def fine_tune(
    scene: Scene,
    dynamic: DynamicGaussians,
    start: FilledVolume,
    volumes: Sequence[FilledVolume | None],
    config: TrajectoryConfig,
    *,
    seed: int,
    checkpoint: Checkpoint,
    progress: Progress,
    known: KnownMotion | None = None,
) -> DeformationNetwork:
    """A copy of the motion of ``dynamic`` that moves ``start`` into ``volumes``, one for each frame after 0. Resumable.

    A frame without a picture has no volume: there only the other terms act.

    With ``known`` the fit starts at its network and keeps its motion, and ``volumes`` belong to the later frames.
    Raises MasivError if the loss becomes non-finite.
    """
    loss = _TrajectoryLoss(scene, dynamic, start, config, known)
    scene.release_pictures()  # the loss keeps the masks in a file
    weights = loss_weights(config)
    network = copy.deepcopy(dynamic.deformation if known is None else known.network).requires_grad_(True)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    first = 0
    state = checkpoint.load()
    if state is not None:
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        first = state["iteration"]

    for iteration in range(first, config.iterations):
        if iteration % config.match_interval == 0:
            # A state is saved only here, since the targets are a function of the network at this iteration.
            checkpoint.maybe_save(partial(_state, network, optimiser, iteration))
            with torch.no_grad():
                moved = loss.points + network.displacements(loss.points, loss.times)
            targets = chamfer_targets(moved.double().numpy(), volumes, start)
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * (0.02 + 0.49 * (1 + math.cos(math.pi * iteration / config.iterations)))
        terms = loss.terms(network, targets, np.random.default_rng([seed, iteration]))
        total = sum((weights[name] * value for name, value in terms.items()), torch.zeros(()))
        if not torch.isfinite(total):
            raise MasivError(
                f"trajectory: the loss became non-finite at iteration {iteration}; lower trajectory.learning_rate"
            )
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        note = ", ".join(f"{name} {float(value.detach()):.3g}" for name, value in terms.items())
        progress("trajectory", iteration + 1, config.iterations, note)
    return network.requires_grad_(False)


def loss_weights(config: TrajectoryConfig) -> Mapping[str, float]:
    """The weight of each term of the loss."""
    return {
        "chamfer": config.chamfer_weight,
        "silhouette": config.silhouette_weight,
        "motion": config.motion_weight,
        "smoothness": config.smoothness_weight,
        "volume": config.volume_weight,
        "rigidity": config.rigidity_weight,
        "ground": config.ground_weight,
        "known": _KNOWN_WEIGHT,
    }


class _TrajectoryLoss:
    """The terms of the loss over all frames after the known ones (frame 0 if there are none)."""

    def __init__(
        self,
        scene: Scene,
        dynamic: DynamicGaussians,
        start: FilledVolume,
        config: TrajectoryConfig,
        known: KnownMotion | None,
    ) -> None:
        self.config, self.spacing, self.ground, self.known = config, start.spacing, scene.ground, known
        self.points = torch.as_tensor(start.points, dtype=torch.float32)
        first = 1 if known is None else len(known.displacements)
        self.known_times = torch.as_tensor(scene.times[:first], dtype=torch.float32)
        self.times = torch.as_tensor(scene.times[first:], dtype=torch.float32)
        self.views = None if scene.load_cloud is not None else load_views(scene, first)
        opaque = dynamic.canonical.opacities.detach().reshape(-1) > 0.1
        self.anchors = dynamic.canonical.means.detach()[opaque]
        guide = dynamic.deformation if known is None else known.network
        with torch.no_grad():
            self.anchor_motion = guide.displacements(self.anchors, self.times)

    def terms(
        self, network: DeformationNetwork, targets: ChamferTargets, rng: np.random.Generator
    ) -> dict[str, torch.Tensor]:
        """The unweighted terms of one step, scalars, on a batch that ``rng`` draws."""
        count = len(self.points)
        batch = torch.as_tensor(rng.permutation(count)[: self.config.batch_size])
        anchors = torch.as_tensor(rng.permutation(len(self.anchors))[:_ANCHORS])
        step = 1.5 * self.spacing
        centres = self.points[torch.as_tensor(rng.permutation(count)[:_STENCILS])]
        evaluated = torch.cat([self.points[batch], self.anchors[anchors], stencil(centres, step)])
        moved, at_anchors, at_stencil = network.displacements(evaluated, self.times).split(
            [len(batch), len(anchors), 7 * len(centres)], dim=1
        )
        positions = self.points[batch] + moved
        square = 1 / self.spacing**2
        chamfer = (positions - targets.targets[:, batch]).square().sum(-1) * targets.weights[:, batch]
        silhouette: dict[str, torch.Tensor] = {}
        if self.views is not None:
            outside = [
                outside_of_mask(at_frame, views[int(rng.integers(len(views)))])
                for at_frame, views in zip(positions, self.views, strict=True)
            ]
            silhouette["silhouette"] = torch.stack(outside).square().mean() * square
        terms = {
            "chamfer": chamfer.sum() * (square * count / len(batch) / len(self.times)),
            **silhouette,
            "motion": (at_anchors - self.anchor_motion[:, anchors]).square().sum(-1).mean() * square,
            **field_terms(at_stencil, step),
        }
        if self.ground is not None:
            terms["ground"] = below_ground(positions, self.ground).square().mean() * square
        if self.known is not None:
            frames = torch.as_tensor(rng.permutation(len(self.known_times))[:_KNOWN_FRAMES])
            off = network.displacements(self.points[batch], self.known_times[frames])
            off = off - self.known.displacements[frames[:, None], batch]
            terms["known"] = off.square().sum(-1).mean() * square
        return terms


def chamfer_targets(moved: np.ndarray, volumes: Sequence[FilledVolume | None], start: FilledVolume) -> ChamferTargets:
    """Chamfer pairs between particles ``moved`` (T, Q, 3) [m] and the T ``volumes``.

    mean_i |x_i - v(x_i)|² + mean_j |v_j - x(v_j)|², v(x) and x(v) being nearest neighbours. Pairs nearer than 0.8
    spacings are ignored: they differ by their sampling only. If a volume exceeds ``_MAX_VOLUME_RATIO`` times that of
    ``start``, its points farthest from the particles are ignored, as shadow volume of the hull.
    """
    targets, weights = moved.copy(), np.zeros(moved.shape[:2])
    noise = 0.8 * start.spacing
    for t, volume in enumerate(volumes):
        if volume is None:
            continue
        count, filled = len(moved[t]), len(volume.points)
        distance, nearest = spatial.cKDTree(volume.points).query(moved[t])
        back, owner = spatial.cKDTree(moved[t]).query(volume.points)
        back_weight = np.where(back > noise, 1.0 / filled, 0.0)
        back_weight[np.argsort(back, kind="stable")[int(_MAX_VOLUME_RATIO * start.volume / volume.spacing**3) :]] = 0.0
        weights[t] = np.where(distance > noise, 1.0 / count, 0.0)
        weighted = weights[t][:, None] * volume.points[nearest]
        weights[t] += np.bincount(owner, back_weight, count)
        for axis in range(3):
            weighted[:, axis] += np.bincount(owner, back_weight * volume.points[:, axis], count)
        matched = weights[t] > 0
        targets[t, matched] = weighted[matched] / weights[t, matched, None]
    return ChamferTargets(torch.as_tensor(targets, dtype=torch.float32), torch.as_tensor(weights, dtype=torch.float32))


def _state(network: DeformationNetwork, optimiser: torch.optim.Optimizer, iteration: int) -> dict[str, Any]:
    return {"network": network.state_dict(), "optimiser": optimiser.state_dict(), "iteration": iteration}
