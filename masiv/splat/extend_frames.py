"""Extend the motion of a finished reconstruction to frames that it was not fitted to.

The canonical Gaussians do not change; only their motion in the new frames is estimated.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from masiv.checkpoint import Checkpoint
from masiv.errors import InputError, MasivError
from masiv.hull.carve import visual_hull
from masiv.hull.shadow_volume import remove_shadow_volume
from masiv.hull.velocity import with_velocities
from masiv.progress import Progress, silent
from masiv.scene.gaps import interpolated
from masiv.scene.scene import Scene
from masiv.splat.clouds import centroid, cloud_objective
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.extrapolate import extrapolate_motion
from masiv.splat.gaussians import Gaussians
from masiv.splat.hull_loss import HullLoss, TreeCache
from masiv.splat.losses import neighbour_pairs
from masiv.splat.objective import Objective
from masiv.splat.observed_image import observed_images


class ExtendFramesConfig(BaseModel):
    """Settings of the extension. Images and their weights are those of ``ReconstructConfig``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    step_ratio: float = Field(0.45, gt=0, description="steps of a new frame over reconstruct's steps of a frame")
    growth_fraction: float = Field(0.65, ge=0, lt=1, description="fraction of the steps in which frames are added")
    pretrain_steps: int = Field(600, ge=1, description="steps, without images, that fit the known motion")
    known_points: int = Field(500, ge=1, description="Gaussians of the loss of the known motion")
    pretrain_rate: float = Field(5e-3, gt=0, description="initial learning rate of the networks' weights in them")
    rate_factor: float = Field(0.5, gt=0, le=1, description="factor of reconstruct's motion_rate and base_rate")
    known_weight: float = Field(300.0, ge=0, description="of the squared change of the known motion")
    known_frames: int = Field(4, ge=1, description="known frames of one step")


def extend_frames(
    scene: Scene,
    dynamic: DynamicGaussians,
    config: ReconstructConfig,
    extension: ExtendFramesConfig,
    *,
    seed: int,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> DynamicGaussians:
    """``dynamic``, fitted to the first frames of ``scene``, with a motion over all frames.

    Cameras are not refined further: ``scene`` has those that were refined with ``dynamic``, and their clocks.

    A new network is first fitted to the known motion, without images. Then the new frames are added one after the
    other, as in ``reconstruct``, with a loss that keeps the known motion. Needs ``masiv.runtime.start``.
    Raises InputError if ``scene`` has no further frame, MasivError if a frame does not show the object or the fit
    diverges. The last state stays in ``checkpoint``: clear it after the result is saved.
    """
    checkpoint = checkpoint or Checkpoint(None)
    fit = _ExtensionFit(scene, dynamic, config, extension, seed, checkpoint.load(), progress)
    while fit.iteration < fit.iterations:
        loss = fit.step()
        checkpoint.maybe_save(fit.state)
        if fit.iteration % 10 == 0 or fit.iteration == fit.iterations:
            progress("extend frames", fit.iteration, fit.iterations, f"loss {loss:.4f}, {fit.frames} frames")
    return DynamicGaussians(dynamic.canonical, fit.network.eval().requires_grad_(False))


class _ExtensionFit:
    """The state of the fit. All random numbers follow from (seed, iteration)."""

    def __init__(
        self,
        scene: Scene,
        dynamic: DynamicGaussians,
        config: ReconstructConfig,
        extension: ExtendFramesConfig,
        seed: int,
        state: dict | None,
        progress: Progress,
    ) -> None:
        self.config, self.extension, self.seed = config, extension, seed
        known = dynamic.deformation
        self.known, self.count = known.frame_count, scene.frame_count
        if self.count <= self.known or not math.isclose(scene.fps, known.fps):
            raise InputError(
                f"{scene.path}: the motion covers {self.known} frames at {known.fps:g} fps and the scene has "
                f"{self.count} at {scene.fps:g} fps: give the same scene, with frames beyond those that were fitted"
            )
        new = range(self.known, self.count)
        self.iterations = math.ceil(extension.step_ratio * config.iterations / self.known * len(new))
        means = dynamic.canonical.means.detach()
        self.gaussians = _parameters(dynamic.canonical)
        self.pairs = neighbour_pairs(means.double().numpy(), config.neighbours)
        self.half_extent = known.settings["half_extent"]
        centroids = self._observe(scene, float(dynamic.canonical.scales.mean()), progress)

        self.known_times = torch.arange(self.known) / scene.fps
        with torch.no_grad():
            self.known_changes = known.changes(means, self.known_times)
        settings = (config.model_dump(exclude={"processes"}), extension.model_dump())
        self.identity = repr((*settings, seed, str(scene.path), self.known, self.count, scene.views))
        resumed = state is not None and state["identity"] == self.identity
        self._begin(known, centroids, pretrain=not resumed)
        if resumed and state is not None:
            self.iteration = state["iteration"]
            self.network.load_state_dict(state["network"])
            self.optimiser.load_state_dict(state["optimiser"])

    def _observe(self, scene: Scene, scale: float, progress: Progress) -> torch.Tensor:
        """Set the objective and the ``images`` of the ``observed`` new frames.

        Returns centroids (K, 3) [m] from the last known frame on, interpolated at frames without a picture.
        """
        config = self.config
        self.observed = [frame for frame in scene.observed_frames if frame >= self.known]
        if not self.observed:
            raise InputError(f"{scene.path} has no picture of a frame from {self.known} on")
        last = max(frame for frame in scene.observed_frames if frame < self.known)
        frames = [last, *self.observed]
        if scene.load_cloud is not None:
            self.objective = cloud_objective(scene, config, self.observed, config.gaussians, scale, self.half_extent)
            self.images = {frame: self.objective.images[frame] for frame in self.observed}
            centroids = np.stack([centroid(scene.cloud(frame).points) for frame in frames])
        else:
            self.images = dict(zip(self.observed, observed_images(scene, config, self.observed), strict=True))
            progress("extend frames", 0, self.iterations, "carving hulls")
            scene = with_velocities(scene)
            first, *hulls = [visual_hull(scene, f, resolution=config.hull_resolution) for f in (0, *frames)]
            hulls = [remove_shadow_volume(scene, f, hull, first.volume) for f, hull in zip(frames, hulls, strict=True)]
            cache = TreeCache()
            losses = {frame: HullLoss(hull, cache) for frame, hull in zip(self.observed, hulls[1:], strict=True)}
            self.objective = Objective(
                config,
                scale,
                self.half_extent,
                scene.fps,
                scene.ground,
                losses,
                self.images,
                scene.view_time_offsets,
            )
            centroids = np.stack([h.points.mean(axis=0) for h in hulls])
        centroids = interpolated([frame - last for frame in frames], centroids, self.count - last)
        return torch.tensor(centroids[self.known - 1 - last :], dtype=torch.float32)

    def _begin(self, known: DeformationNetwork, centroids: torch.Tensor, *, pretrain: bool) -> None:
        """A network of all frames. ``centroids`` of the hulls, from the last known frame on, extend the base motion."""
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
        # The known motion, stretched over all frames, is a better initial value than random weights.
        old, new = known.state_dict(), self.network.state_dict()
        names = [name for name, value in new.items() if name != "base_motion" and value.shape == old[name].shape]
        self.network.load_state_dict({**new, **{name: old[name] for name in names}})
        weights = [p for name, p in self.network.named_parameters() if name != "base_motion"]
        if pretrain:
            self._fit_known_motion(weights)
        c, factor = self.config, self.extension.rate_factor
        groups = [{"params": weights, "rate": factor * c.motion_rate}]
        groups += [{"params": [self.network.base_motion], "rate": factor * c.base_rate * self.half_extent}]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15)

    def _fit_known_motion(self, weights: list[torch.nn.Parameter]) -> None:
        rng = np.random.default_rng((self.seed, 0))
        steps = self.extension.pretrain_steps
        optimiser = torch.optim.Adam(weights, lr=0.0)
        for step in range(steps):
            for group in optimiser.param_groups:
                group["lr"] = self.extension.pretrain_rate * (0.01 + 0.495 * (1 + math.cos(math.pi * step / steps)))
            optimiser.zero_grad()
            self._known_motion_loss(np.arange(self.known), rng).backward()
            optimiser.step()
        extrapolate_motion(self.network, self.gaussians["means"], self.known, self.config.motion_rate, rng)

    def _known_motion_loss(self, frames: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
        """Mean squared change of the known motion at known ``frames``, a scalar; lengths in half-extents."""
        means, (displacements, log_scales) = self.gaussians["means"], self.known_changes
        points = torch.from_numpy(rng.permutation(len(means))[: self.extension.known_points])
        moved, resized = self.network.changes(means[points], self.known_times[frames])
        rows = torch.from_numpy(frames)[:, None]
        off = (moved - displacements[rows, points]).square().sum(-1) / self.half_extent**2
        return off.mean() + 0.01 * (resized - log_scales[rows, points]).square().mean()

    def state(self) -> dict[str, Any]:
        """What a resumed fit needs, as tensors and plain values."""
        return {
            "identity": self.identity,
            "iteration": self.iteration,
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    @property
    def frames(self) -> int:
        """How many frames, known and new, are in the fit at this iteration."""
        new = self.count - self.known
        done = self.iteration / self.iterations / max(self.extension.growth_fraction, 1e-9)
        return self.known + min(new, 1 + int(done * new))

    @property
    def annealing(self) -> float:
        """0 until all frames are in, then up to 1: learning rates and the weight of the hulls decrease with it."""
        fraction = self.extension.growth_fraction
        return max(0.0, (self.iteration / self.iterations - fraction) / (1 - fraction))

    def step(self) -> float:
        """One step of Adam on a batch of images of new frames; returns the loss."""
        c = self.config
        rng = np.random.default_rng((self.seed, 1 + self.iteration))
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * c.final_rate_factor**self.annealing
        self.optimiser.zero_grad(set_to_none=True)
        chosen = self._choose_images(rng)
        loss = self.objective(self.gaussians, self.network, self.pairs, chosen, 1 - self.annealing, rng)
        known = np.sort(rng.permutation(self.known)[: self.extension.known_frames])
        loss = loss + self.extension.known_weight * self._known_motion_loss(known, rng)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise MasivError(
                f"the extension to new frames diverged at step {self.iteration} of {self.iterations}: "
                "lower reconstruct.motion_rate"
            )
        loss.backward()
        self.network.hold_base_motion(self.frames)
        self.optimiser.step()
        frames = self.frames
        self.iteration += 1
        if self.frames > frames:
            extrapolate_motion(self.network, self.gaussians["means"], self.frames - 1, c.motion_rate, rng)
        return value

    def _choose_images(self, rng: np.random.Generator) -> list[tuple[int, int]]:
        """(frame, index of its image). One shows the newest frame while frames are added, others a random new one."""
        in_fit = [frame for frame in self.observed if frame < self.frames] or self.observed[:1]
        chosen = rng.integers(len(in_fit), size=self.config.batch_size)
        if self.annealing == 0:
            chosen[0] = len(in_fit) - 1
        return [(in_fit[k], int(rng.integers(len(self.images[in_fit[k]])))) for k in chosen]


def _parameters(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """The parameters that ``Objective`` takes, without gradients."""
    return {
        "means": gaussians.means.detach().float(),
        "log_scales": gaussians.scales.detach().float().log(),
        "opacity_logits": torch.logit(gaussians.opacities.detach().float(), eps=1e-6),
        "colour_logits": torch.logit(gaussians.colours.detach().float(), eps=1e-6),
    }
