"""Dynamic Gaussians from multi-view video: MASIV's first stage ("Dynamic Gaussians"), made short and resumable."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.progress import Progress
from masiv.scene.scene import Scene
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.gaussians import Gaussians
from masiv.splat.losses import neighbour_pairs, ssim, strain
from masiv.splat.observe import Observation, observe
from masiv.splat.pull import HullPull, continue_motion
from masiv.splat.rasteriser import render
from masiv.splat.start import Start, starting_point

__all__ = ["DynamicGaussians", "reconstruct"]

_PULLED = 700
"""Gaussians, and points of a hull, that one step measures."""
_NAMES = ("means", "log_scales", "opacity_logits", "colour_logits")


def reconstruct(
    scene: Scene, config: ReconstructConfig, *, seed: int, checkpoint: Checkpoint, progress: Progress
) -> DynamicGaussians:
    """Fit Gaussians at frame 0 and their motion to all that ``scene`` may look at. Needs ``masiv.runtime.start``.

    Frames come in one after the other, each starting from where the motion so far leads, so that a material point is
    followed instead of found again. Raises MasivError where no frame shows the object or the fit diverges.
    A finished stage leaves its last state in ``checkpoint``; whoever saves the result clears it.
    """
    fit = _Fit(scene, config, seed, checkpoint.load(), progress)
    while fit.iteration < config.iterations:
        loss = fit.step()
        checkpoint.maybe_save(fit.state)
        if fit.iteration % 10 == 0 or fit.iteration == config.iterations:
            progress("reconstruct", fit.iteration, config.iterations, f"loss {loss:.4f}, {fit.frames} frames")
    return DynamicGaussians(fit.canonical(), fit.network.eval().requires_grad_(False))


class _Fit:
    """The state of a fit and one step of it. Everything random comes from (seed, iteration)."""

    def __init__(
        self, scene: Scene, config: ReconstructConfig, seed: int, state: dict | None, progress: Progress
    ) -> None:
        self.config, self.seed, self.scene = config, seed, scene
        self.observations = _observations(scene, config)
        self.identity = repr((config.model_dump(), seed, str(scene.path), scene.frame_count, scene.views))
        progress("reconstruct", 0, config.iterations, "carving hulls")
        start = starting_point(scene, config.gaussians, config.hull_resolution, np.random.default_rng((seed, 0)))
        self.first_scale, self.half_extent = start.scale, start.half_extent
        self.pulls = [HullPull(hull) for hull in start.hulls]
        if state is not None and state["identity"] == self.identity:
            self._resume(state)
        else:
            self._begin(start)

    def _begin(self, start: Start) -> None:
        self.iteration = 0
        self.parameters = {
            "means": torch.tensor(start.means, dtype=torch.float32),
            "log_scales": torch.full((len(start.means),), float(np.log(start.scale))),
            "opacity_logits": torch.full((len(start.means),), 1.0),
            "colour_logits": torch.logit(torch.tensor(start.colours, dtype=torch.float32).clamp(0.02, 0.98)),
        }
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            self.network = self._network(torch.tensor(start.centre), torch.tensor(start.base_motion))
        self._start_optimiser()

    def _resume(self, state: dict) -> None:
        self.iteration = state["iteration"]
        self.parameters = state["parameters"]
        self.network = self._network(state["network"]["centre"], state["network"]["base_motion"])
        self.network.load_state_dict(state["network"])
        self._start_optimiser()
        self.optimiser.load_state_dict(state["optimiser"])
        self.pairs = tuple(state["pairs"])

    def state(self) -> dict[str, Any]:
        """All that a resumed fit needs, as tensors and plain values."""
        return {
            "identity": self.identity,
            "iteration": self.iteration,
            "parameters": {name: value.detach() for name, value in self.parameters.items()},
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "pairs": list(self.pairs),
        }

    def _network(self, centre: torch.Tensor, base_motion: torch.Tensor) -> DeformationNetwork:
        c = self.config
        return DeformationNetwork(
            centre=centre,
            half_extent=self.half_extent,
            frame_count=self.scene.frame_count,
            fps=self.scene.fps,
            base_motion=base_motion,
            bases=c.bases,
            width=c.width,
            depth=c.depth,
            space_octaves=c.space_octaves,
            time_octaves=c.time_octaves,
        )

    def _start_optimiser(self) -> None:
        c, extent = self.config, self.half_extent
        rates = dict(zip(_NAMES, (c.means_rate * extent, c.scale_rate, c.opacity_rate, c.colour_rate), strict=True))
        self.parameters = {name: value.requires_grad_() for name, value in self.parameters.items()}
        weights = [p for name, p in self.network.named_parameters() if name != "base_motion"]
        groups = [{"params": [self.parameters[name]], "rate": rates[name]} for name in _NAMES]
        groups += [{"params": weights, "rate": c.motion_rate}]
        groups += [{"params": [self.network.base_motion], "rate": c.base_rate * extent}]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
        self._find_neighbours()

    def _find_neighbours(self) -> None:
        pairs = neighbour_pairs(self.parameters["means"].detach().double().numpy(), self.config.neighbours)
        self.pairs = tuple(torch.from_numpy(p) for p in pairs)

    @property
    def frames(self) -> int:
        """How many frames are in the fit at this iteration: 1 at first, then one more at a time."""
        c, count = self.config, self.scene.frame_count
        done = self.iteration / c.iterations - c.first_frame_share
        if done < 0:
            return 1
        return min(count, 2 + int(done / max(c.growth_share, 1e-9) * (count - 1)))

    @property
    def settling(self) -> float:
        """0 until all frames are in, then up to 1: steps shrink and the hulls' pull fades along it."""
        grown = self.config.first_frame_share + self.config.growth_share
        return max(0.0, (self.iteration / self.config.iterations - grown) / (1 - grown))

    def canonical(self) -> Gaussians:
        p = {name: value.detach() for name, value in self.parameters.items()}
        return Gaussians(
            p["means"], p["log_scales"].exp(), torch.sigmoid(p["opacity_logits"]), torch.sigmoid(p["colour_logits"])
        )

    def step(self) -> float:
        """One step of Adam on a few views of one frame; the loss."""
        c = self.config
        rng = np.random.default_rng((self.seed, 1 + self.iteration))
        frame = self._choose_frame(rng)
        shown = self.observations[frame]
        chosen = rng.permutation(len(shown))[: c.views]
        background = torch.tensor(rng.random(3), dtype=torch.float32)
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * c.final_rate**self.settling

        self.optimiser.zero_grad(set_to_none=True)
        loss = self._loss(frame, [shown[k] for k in chosen], background, rng)
        value = float(loss.detach())
        if not np.isfinite(value):
            raise MasivError(
                f"reconstruct diverged at step {self.iteration} of {c.iterations}: lower reconstruct.motion_rate and "
                "reconstruct.means_rate"
            )
        loss.backward()
        self.optimiser.step()
        frames = self.frames
        self.iteration += 1
        if self.frames > frames:
            self._continue_motion(rng)
        if self.iteration in self._pruning_steps():
            self._prune()
        return value

    def _choose_frame(self, rng: np.random.Generator) -> int:
        """While frames come in, the newest one a third of the time: it is followed before the next one comes."""
        if self.frames < self.scene.frame_count and rng.random() < 1 / 3:
            return self.frames - 1
        return int(rng.integers(self.frames))

    def _loss(
        self, frame: int, shown: list[Observation], background: torch.Tensor, rng: np.random.Generator
    ) -> torch.Tensor:
        c, p = self.config, self.parameters
        means, log_scales = p["means"], p["log_scales"]
        regulariser = c.scale_weight * log_scales.exp().mean() / self.first_scale
        if frame > 0:
            # The position goes into the network without a gradient, as in MASIV: the motion answers for the motion.
            displacement, log_change = self.network(means.detach(), frame / self.scene.fps)
            if c.rigidity_weight > 0:
                stretched = strain(means.detach(), displacement, *self.pairs, softening=self.first_scale)
                regulariser = regulariser + c.rigidity_weight * stretched
            means, log_scales = means + displacement, log_scales + log_change
            if c.hull_weight > 0 and self.settling < 1:
                far = self.pulls[frame](p["means"].detach() + displacement, _PULLED, rng)
                regulariser = regulariser + c.hull_weight * (1 - self.settling) * far / self.half_extent
        scales, opacities, colours = (
            log_scales.exp(),
            torch.sigmoid(p["opacity_logits"]),
            torch.sigmoid(p["colour_logits"]),
        )
        total = torch.zeros(())
        for view in shown:
            drawn = render(view.camera, means, scales, opacities, colours, background)
            total = total + _difference(drawn.rgb, drawn.alpha, view, background, c)
        return total / len(shown) + regulariser

    def _continue_motion(self, rng: np.random.Generator) -> None:
        continue_motion(self.network, self.parameters["means"].detach(), self.frames - 1, self.config.motion_rate, rng)

    def _pruning_steps(self) -> tuple[int, ...]:
        """After frame 0 alone, and twice while all frames are in."""
        n, c = self.config.iterations, self.config
        grown = c.first_frame_share + c.growth_share
        return tuple(int(n * share) for share in (c.first_frame_share, grown, (1 + grown) / 2) if int(n * share) < n)

    def _prune(self) -> None:
        """Remove transparent Gaussians, with their optimiser state, and look for neighbours again."""
        keep = torch.sigmoid(self.parameters["opacity_logits"].detach()) >= self.config.prune_opacity
        if int(keep.sum()) < 2:
            raise MasivError("reconstruct: every Gaussian became transparent; check the masks of the scene")
        for group, name in zip(self.optimiser.param_groups, _NAMES, strict=False):
            old = self.parameters[name]
            new = old.detach()[keep].clone().requires_grad_()
            moments = self.optimiser.state.pop(old)
            self.optimiser.state[new] = {k: v[keep] if v.shape == old.shape else v for k, v in moments.items()}
            group["params"] = [new]
            self.parameters[name] = new
        self._find_neighbours()


def _observations(scene: Scene, config: ReconstructConfig) -> list[list[Observation]]:
    """What each frame shows. Raises MasivError for a frame that no view sees the object in."""
    found = []
    for frame in range(scene.frame_count):
        of_frame = [
            observe(scene, view, frame, crop_side=config.crop_side, crop_padding=config.crop_padding)
            for view in scene.views
        ]
        found.append([o for o in of_frame if o is not None])
        if not found[-1]:
            raise MasivError(f"frame {frame} of {scene.path}: no view shows the object; check its masks")
    return found


def _difference(
    rgb: torch.Tensor, alpha: torch.Tensor, view: Observation, background: torch.Tensor, config: ReconstructConfig
) -> torch.Tensor:
    """(1 - l) L1 + l (1 - SSIM) over the background, plus alpha against the mask; pixels behind an occluder agree."""
    target = view.colour + (1 - view.mask)[..., None] * background
    rgb = torch.lerp(target, rgb, view.valid[..., None])
    absolute = (rgb - target).abs().mean()
    silhouette = ((alpha - view.mask) * view.valid).abs().mean()
    similarity = ssim(rgb, target) if config.ssim_weight > 0 else 1.0
    return (
        (1 - config.ssim_weight) * absolute + config.ssim_weight * (1 - similarity) + config.alpha_weight * silhouette
    )
