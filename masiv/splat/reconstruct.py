"""Dynamic Gaussians from multi-view video: MASIV's first stage ("Dynamic Gaussians"), made short and resumable."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch

from masiv import runtime
from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.progress import Progress
from masiv.scene.scene import Scene
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.gaussians import Gaussians
from masiv.splat.losses import neighbour_pairs
from masiv.splat.objective import NAMES, Objective, Part
from masiv.splat.observed_image import ObservedImage, observed_image
from masiv.splat.pull import HullPull, continue_motion
from masiv.splat.share import Second, leaves, slopes
from masiv.splat.start import Start, starting_point
from masiv.workers import processes_wanted

__all__ = ["DynamicGaussians", "observations", "reconstruct"]


def reconstruct(
    scene: Scene, config: ReconstructConfig, *, seed: int, checkpoint: Checkpoint, progress: Progress
) -> DynamicGaussians:
    """Fit Gaussians at frame 0 and their motion to all that ``scene`` may look at. Needs ``masiv.runtime.start``.

    Frames come in one after the other, each starting from where the motion so far leads, so that a material point is
    followed instead of found again. Raises MasivError where no frame shows the object or the fit diverges.
    A finished stage leaves its last state in ``checkpoint``; whoever saves the result clears it.
    """
    # Windows hands no files on to another process.
    two = config.pictures > 1 and processes_wanted(config.processes) > 1 and os.name == "posix"
    # On a few cores, two processes on half the threads each; the numbers depend on the threads, not on the processes.
    with runtime.torch_threads(max(1, torch.get_num_threads() // 2)), Second() if two else nullcontext() as second:
        fit = _Fit(scene, config, seed, checkpoint.load(), progress, second)
        while fit.iteration < config.iterations:
            loss = fit.step()
            checkpoint.maybe_save(fit.state)
            if fit.iteration % 10 == 0 or fit.iteration == config.iterations:
                progress("reconstruct", fit.iteration, config.iterations, f"loss {loss:.4f}, {fit.frames} frames")
    return DynamicGaussians(fit.canonical(), fit.network.eval().requires_grad_(False))


class _Fit:
    """The state of a fit and one step of it. Everything random comes from (seed, iteration)."""

    def __init__(
        self,
        scene: Scene,
        config: ReconstructConfig,
        seed: int,
        state: dict | None,
        progress: Progress,
        second: Second | None = None,
    ) -> None:
        self.config, self.seed, self.scene, self.second = config, seed, scene, second
        self.observations = observations(scene, config, range(scene.frame_count))
        self.identity = repr(
            (config.model_dump(exclude={"processes"}), seed, str(scene.path), scene.frame_count, scene.views)
        )
        progress("reconstruct", 0, config.iterations, "carving hulls")
        start = starting_point(scene, config.gaussians, config.hull_resolution, np.random.default_rng((seed, 0)))
        self.half_extent = start.half_extent
        hulls = tuple(HullPull(hull) for hull in start.hulls)
        self.objective = Objective(
            config, start.scale, start.half_extent, scene.fps, scene.ground, hulls, self.observations
        )
        if state is not None and state["identity"] == self.identity:
            self._resume(state)
        else:
            self._begin(start)
        if second is not None:
            second.give(self.objective, self.network, len(self.parameters["means"]))

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
        rates = dict(zip(NAMES, (c.means_rate * extent, c.scale_rate, c.opacity_rate, c.colour_rate), strict=True))
        self.parameters = {name: value.requires_grad_() for name, value in self.parameters.items()}
        weights = [p for name, p in self.network.named_parameters() if name != "base_motion"]
        groups = [{"name": name, "params": [self.parameters[name]], "rate": rates[name]} for name in NAMES]
        groups += [{"name": "weights", "params": weights, "rate": c.motion_rate}]
        groups += [{"name": "base_motion", "params": [self.network.base_motion], "rate": c.base_rate * extent}]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)
        self._find_neighbours()

    def _find_neighbours(self) -> None:
        means = self.parameters["means"].detach().double().numpy()
        self.pairs = neighbour_pairs(means, self.config.neighbours)

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
        """One step of Adam on a few pictures; the loss."""
        c = self.config
        rng = np.random.default_rng((self.seed, 1 + self.iteration))
        pictures = self._choose_pictures(rng)
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * c.final_rate**self.settling
        if self.frames > 1:
            # Points that go on sliding over the surface, or colours that pass over them, show what moved as well as
            # motion does, and faster: a spin would be followed with a lag.
            for group in self.optimiser.param_groups:
                if group["name"] == "means" or (group["name"] == "colour_logits" and self.settling == 0):
                    group["lr"] *= c.followed_rate
        parts = self.objective.parts(len(self.parameters["means"]), pictures, 1 - self.settling, rng)
        value = self._find_slopes(parts)
        if not np.isfinite(value):
            raise MasivError(
                f"reconstruct diverged at step {self.iteration} of {c.iterations}: lower reconstruct.motion_rate and "
                "reconstruct.means_rate"
            )
        self.optimiser.step()
        frames = self.frames
        self.iteration += 1
        if self.frames > frames:
            means = self.parameters["means"].detach()
            continue_motion(self.network, means, self.frames - 1, c.motion_rate, rng)
        if self.iteration in self._pruning_steps():
            self._prune()
        return value

    def _find_slopes(self, parts: tuple[Part, ...]) -> float:
        """Set the gradient of every parameter to the sum over ``parts``, in their order; the loss."""
        given = (self.objective, self.parameters, self.network, self.pairs)
        if self.second is None:
            found = [slopes(*given, part) for part in parts]
        else:
            first, other = parts
            self.second.begin(*given[1:], other)
            found = [slopes(*given, first), self.second.end()]
        for leaf, *each in zip(leaves(self.parameters, self.network), *(s for _, s in found), strict=True):
            known = [slope for slope in each if slope is not None]
            leaf.grad = sum(known[1:], known[0]) if known else None
        return sum(value for value, _ in found)

    def _choose_pictures(self, rng: np.random.Generator) -> list[tuple[int, int]]:
        """The newest frame while frames come in, so that it is followed before the next one comes; others at random."""
        frames = rng.integers(self.frames, size=self.config.pictures)
        if self.frames < self.scene.frame_count:
            frames[0] = self.frames - 1
        return [(int(f), int(rng.integers(len(self.observations[f])))) for f in frames]

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
        for group, name in zip(self.optimiser.param_groups, NAMES, strict=False):
            old = self.parameters[name]
            new = old.detach()[keep].clone().requires_grad_()
            moments = self.optimiser.state.pop(old)
            self.optimiser.state[new] = {k: v[keep] if v.shape == old.shape else v for k, v in moments.items()}
            group["params"] = [new]
            self.parameters[name] = new
        self._find_neighbours()


def observations(scene: Scene, config: ReconstructConfig, frames: Iterable[int]) -> list[list[ObservedImage]]:
    """What each of ``frames`` shows. Raises MasivError for a frame that no view sees the object in."""
    found = []
    for frame in frames:
        of_frame = [
            observed_image(scene, view, frame, crop_side=config.crop_side, crop_padding=config.crop_padding)
            for view in scene.views
        ]
        found.append([o for o in of_frame if o is not None])
        if not found[-1]:
            raise MasivError(f"frame {frame} of {scene.path}: no view shows the object; check its masks")
    return found
