"""The motion of frames that a finished reconstruction has not seen: its Gaussians, followed further.

What is fitted on the first frames of a scene stays what it is; only where it goes afterwards is measured here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError, MasivError
from masiv.hull.carve import visual_hull
from masiv.hull.settle import settled_hull
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.follow_config import FollowConfig
from masiv.splat.gaussians import Gaussians
from masiv.splat.losses import neighbour_pairs
from masiv.splat.objective import Objective
from masiv.splat.pull import HullPull, continue_motion
from masiv.splat.reconstruct import observations


def follow(
    scene: Scene,
    dynamic: DynamicGaussians,
    config: ReconstructConfig,
    follow_config: FollowConfig,
    *,
    seed: int,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> DynamicGaussians:
    """``dynamic``, of the first frames of ``scene``, with a motion over all of them. Needs ``masiv.runtime.start``.

    The canonical Gaussians are those of ``dynamic``. A new network learns their known motion, without pictures; then
    the new frames come in one after the other as in ``reconstruct``, while it rehearses what it knew.
    Raises InputError where ``scene`` has no further frame, MasivError where one does not show the object or the fit
    diverges. A finished stage leaves its last state in ``checkpoint``; whoever saves the result clears it.
    """
    checkpoint = checkpoint or Checkpoint(None)
    fit = _Following(scene, dynamic, config, follow_config, seed, checkpoint.load(), progress)
    while fit.iteration < fit.iterations:
        loss = fit.step()
        checkpoint.maybe_save(fit.state)
        if fit.iteration % 10 == 0 or fit.iteration == fit.iterations:
            progress("follow", fit.iteration, fit.iterations, f"loss {loss:.4f}, {fit.frames} frames")
    return DynamicGaussians(dynamic.canonical, fit.network.eval().requires_grad_(False))


class _Following:
    """The state of the pass and one step of it. Everything random comes from (seed, iteration)."""

    def __init__(
        self,
        scene: Scene,
        dynamic: DynamicGaussians,
        config: ReconstructConfig,
        follow_config: FollowConfig,
        seed: int,
        state: dict | None,
        progress: Progress,
    ) -> None:
        self.config, self.own, self.seed = config, follow_config, seed
        known = dynamic.deformation
        self.known, self.count = known.frame_count, scene.frame_count
        if self.count <= self.known or not math.isclose(scene.fps, known.fps):
            raise InputError(
                f"{scene.path}: the motion covers {self.known} frames at {known.fps:g} fps and the scene has "
                f"{self.count} at {scene.fps:g} fps: give the same scene, with frames beyond those that were fitted"
            )
        new = range(self.known, self.count)
        self.iterations = math.ceil(follow_config.effort * config.iterations / self.known * len(new))
        self.observations = dict(zip(new, observations(scene, config, new), strict=True))
        progress("follow", 0, self.iterations, "carving hulls")
        frames = range(self.known - 1, self.count)
        first, *hulls = [visual_hull(scene, f, resolution=config.hull_resolution) for f in (0, *frames)]
        hulls = [settled_hull(scene, f, hull, first.volume) for f, hull in zip(frames, hulls, strict=True)]

        means = dynamic.canonical.means.detach()
        self.gaussians = _parameters(dynamic.canonical)
        self.pairs = neighbour_pairs(means.double().numpy(), config.neighbours)
        self.half_extent = known.settings["half_extent"]
        pulls = {frame: HullPull(hull) for frame, hull in zip(new, hulls[1:], strict=True)}
        scale = float(dynamic.canonical.scales.mean())
        self.objective = Objective(config, scale, self.half_extent, scene.fps, scene.ground, pulls, self.observations)

        self.known_times = torch.arange(self.known) / scene.fps
        with torch.no_grad():
            self.known_changes = known.changes(means, self.known_times)
        centroids = torch.tensor(np.stack([h.points.mean(axis=0) for h in hulls]), dtype=torch.float32)
        asked = (
            config.model_dump(exclude={"processes"}),
            follow_config.model_dump(),
            seed,
            str(scene.path),
            self.known,
            self.count,
        )
        self.identity = repr((*asked, scene.views))
        resumed = state is not None and state["identity"] == self.identity
        self._begin(known, centroids, relearn=not resumed)
        if resumed and state is not None:
            self.iteration = state["iteration"]
            self.network.load_state_dict(state["network"])
            self.optimiser.load_state_dict(state["optimiser"])

    def _begin(self, known: DeformationNetwork, centroids: torch.Tensor, *, relearn: bool) -> None:
        """A network for all frames, its base motion extended by ``centroids`` of the hulls from the last known one."""
        self.iteration = 0
        base = known.base_motion.detach()
        settings = {**known.settings, "frame_count": self.count, "time_octaves": self.config.time_octaves}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            self.network = DeformationNetwork(
                centre=known.centre,
                base_motion=torch.cat([base, base[-1] + centroids[1:] - centroids[0]]),
                **settings,
            )
        # The same motion, played slower, is nearer to the known one than a random network.
        warm, own = known.state_dict(), self.network.state_dict()
        names = [name for name, value in own.items() if name != "base_motion" and value.shape == warm[name].shape]
        self.network.load_state_dict({**own, **{name: warm[name] for name in names}})
        weights = [p for name, p in self.network.named_parameters() if name != "base_motion"]
        if relearn:
            self._relearn(weights)
        c, share = self.config, self.own.rate_share
        groups = [{"params": weights, "rate": share * c.motion_rate}]
        groups += [{"params": [self.network.base_motion], "rate": share * c.base_rate * self.half_extent}]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15)

    def _relearn(self, weights: list[torch.nn.Parameter]) -> None:
        rng = np.random.default_rng((self.seed, 0))
        steps = self.own.relearn_steps
        optimiser = torch.optim.Adam(weights, lr=0.0)
        for step in range(steps):
            for group in optimiser.param_groups:
                group["lr"] = self.own.relearn_rate * (0.01 + 0.495 * (1 + math.cos(math.pi * step / steps)))
            optimiser.zero_grad()
            self._forgotten(np.arange(self.known), rng).backward()
            optimiser.step()
        continue_motion(self.network, self.gaussians["means"], self.known, self.config.motion_rate, rng)

    def _forgotten(self, frames: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
        """Mean squared change of the known motion, lengths in half-extents, at known ``frames``; a scalar."""
        means, (displacements, log_scales) = self.gaussians["means"], self.known_changes
        points = torch.from_numpy(rng.permutation(len(means))[: self.own.relearn_points])
        moved, resized = self.network.changes(means[points], self.known_times[frames])
        rows = torch.from_numpy(frames)[:, None]
        off = (moved - displacements[rows, points]).square().sum(-1) / self.half_extent**2
        return off.mean() + 0.01 * (resized - log_scales[rows, points]).square().mean()

    def state(self) -> dict[str, Any]:
        """All that a resumed pass needs, as tensors and plain values."""
        return {
            "identity": self.identity,
            "iteration": self.iteration,
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    @property
    def frames(self) -> int:
        """How many frames are followed at this iteration, the known ones among them."""
        new = self.count - self.known
        done = self.iteration / self.iterations / max(self.own.growth_share, 1e-9)
        return self.known + min(new, 1 + int(done * new))

    @property
    def settling(self) -> float:
        """0 until all frames have had their time, then up to 1: steps shrink and the hulls' pull fades along it."""
        share = self.own.growth_share
        return max(0.0, (self.iteration / self.iterations - share) / (1 - share))

    def step(self) -> float:
        """One step of Adam on a few pictures of new frames; the loss."""
        c, own = self.config, self.own
        rng = np.random.default_rng((self.seed, 1 + self.iteration))
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * c.final_rate**self.settling
        self.optimiser.zero_grad(set_to_none=True)
        pictures = self._choose_pictures(rng)
        loss = self.objective(self.gaussians, self.network, self.pairs, pictures, 1 - self.settling, rng)
        rehearsed = np.sort(rng.permutation(self.known)[: own.rehearsal_frames])
        loss = loss + own.rehearsal_weight * self._forgotten(rehearsed, rng)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise MasivError(
                f"following new frames diverged at step {self.iteration} of {self.iterations}: "
                "lower reconstruct.motion_rate"
            )
        loss.backward()
        self.optimiser.step()
        frames = self.frames
        self.iteration += 1
        if self.frames > frames:
            continue_motion(self.network, self.gaussians["means"], self.frames - 1, c.motion_rate, rng)
        return value

    def _choose_pictures(self, rng: np.random.Generator) -> list[tuple[int, int]]:
        """The newest frame while frames come in; others at random among the new ones that are in."""
        frames = rng.integers(self.known, self.frames, size=self.config.pictures)
        if self.settling == 0:
            frames[0] = self.frames - 1
        return [(int(f), int(rng.integers(len(self.observations[int(f)])))) for f in frames]


def _parameters(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """What ``Objective`` takes, without gradients."""
    return {
        "means": gaussians.means.detach().float(),
        "log_scales": gaussians.scales.detach().float().log(),
        "opacity_logits": torch.logit(gaussians.opacities.detach().float(), eps=1e-6),
        "colour_logits": torch.logit(gaussians.colours.detach().float(), eps=1e-6),
    }
