"""Dynamic Gaussians from multi-view video: MASIV's first stage ("Dynamic Gaussians"), faster and resumable."""

from __future__ import annotations

import os
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch

from masiv import runtime
from masiv.calibration.from_silhouettes import calibrate_from_silhouettes
from masiv.checkpoint import Checkpoint
from masiv.errors import MasivError
from masiv.progress import Progress
from masiv.scene.calibration import Calibration
from masiv.scene.gaps import interpolated
from masiv.scene.scene import Scene
from masiv.splat.clouds import cloud_objective, for_clouds, initial_from_clouds
from masiv.splat.config import ReconstructConfig
from masiv.splat.data_parallel import GradientWorker, Networks, gradients, parameters
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.extrapolate import extrapolate_motion
from masiv.splat.gaussians import Gaussians
from masiv.splat.hull_loss import HullLoss, TreeCache
from masiv.splat.image_formation import ImageFormation
from masiv.splat.initialize import InitialGaussians, initial_gaussians
from masiv.splat.losses import neighbour_pairs
from masiv.splat.objective import PARAMETER_NAMES, Objective, Part
from masiv.splat.observed_image import observed_images
from masiv.workers import process_count

HULL_POINTS = 300
"""Points of a frame's hull that say how far a correction of a camera moves the object in its picture."""


def reconstruct(
    scene: Scene, config: ReconstructConfig, *, seed: int, checkpoint: Checkpoint, progress: Progress
) -> DynamicGaussians:
    """Fit Gaussians at frame 0 and their motion to all frames of ``scene``; held-out views are not used.

    Frames are added one after the other. Each starts from the extrapolated motion, so that material points are tracked.
    Of point clouds, the Gaussians are points of the first one and the motion registers them to the others.
    Needs ``masiv.runtime.start``. Raises MasivError if a frame does not show the object or the fit diverges.
    The last state stays in ``checkpoint``: clear it after the result is saved.
    """
    # A process of Windows cannot inherit the file that both map.
    two = config.batch_size > 1 and process_count(config.processes) > 1 and os.name == "posix"
    # Two processes on half the threads each. The numbers depend on the threads, not on the processes.
    threads = max(1, torch.get_num_threads() // 2)
    with runtime.torch_threads(threads), GradientWorker() if two else nullcontext() as worker:
        fit = _Fit(scene, config, seed, checkpoint.load(), progress, worker)
        while fit.iteration < config.iterations:
            loss = fit.step()
            checkpoint.maybe_save(fit.state)
            if fit.iteration % 10 == 0 or fit.iteration == config.iterations:
                progress("reconstruct", fit.iteration, config.iterations, f"loss {loss:.4f}, {fit.frames} frames")
    return DynamicGaussians(fit.canonical(), fit.network.eval().requires_grad_(False), fit.calibration())


class _Fit:
    """The state of the fit. All random numbers follow from (seed, iteration)."""

    def __init__(
        self,
        scene: Scene,
        config: ReconstructConfig,
        seed: int,
        state: dict | None,
        progress: Progress,
        worker: GradientWorker | None = None,
    ) -> None:
        self.config = config if scene.load_cloud is None else for_clouds(config)
        self.seed, self.scene, self.worker = seed, scene, worker
        self.silhouettes, self.by_silhouettes = None, None
        self.identity = repr(
            (config.model_dump(exclude={"processes"}), seed, str(scene.path), scene.frame_count, scene.views)
        )
        shutters = [scene.cameras[view].shutter for view in scene.views]
        self.identity += "" if all(s.is_instant for s in shutters) else repr(shutters)
        if self.config.refine_calibration:
            progress("reconstruct", 0, config.iterations, "cameras from silhouettes")
            self._correct_cameras()
        initial = self._observe(progress)
        self.half_extent = initial.half_extent
        self.formation = self._image_formation(initial) if self.config.refine_calibration else None
        if state is not None and state["identity"] == self.identity:
            self._resume(state)
        else:
            self._begin(initial)
        if worker is not None:
            worker.configure(self.objective, self.networks, len(self.parameters["means"]))

    def _correct_cameras(self) -> None:
        """Hulls, images and the refinement of cameras start from cameras that agree with the silhouettes."""
        found = calibrate_from_silhouettes(self.scene, self.config.calibration)
        if found is not None:
            self.silhouettes = found
            self.by_silhouettes = Calibration.of(
                self.scene,
                found.corrections,
                found.pivot,
                found.points,
                standard_errors_px=found.standard_errors_px,
            )
            self.scene = self.by_silhouettes.applied_to(self.scene)

    def _observe(self, progress: Progress) -> InitialGaussians:
        """Set the objective, ``images`` by frame and their number; returns the start of the fit."""
        scene, config = self.scene, self.config
        if scene.load_cloud is not None:
            progress("reconstruct", 0, config.iterations, "reading point clouds")
            initial = initial_from_clouds(scene, config.gaussians)
            self.objective = cloud_objective(
                scene, config, range(scene.frame_count), config.gaussians, initial.scale, initial.half_extent
            )
            self.images = [self.objective.images[frame] for frame in range(scene.frame_count)]
            return initial
        self.images = observed_images(scene, config, range(scene.frame_count))
        progress("reconstruct", 0, config.iterations, "carving hulls")
        initial = initial_gaussians(
            scene, config.gaussians, config.hull_resolution, np.random.default_rng((self.seed, 0))
        )
        cache = TreeCache()
        hulls = {frame: HullLoss(hull, cache) for frame, hull in zip(initial.frames, initial.hulls, strict=True)}
        self.objective = Objective(
            config,
            initial.scale,
            initial.half_extent,
            scene.fps,
            scene.ground,
            hulls,
            self.images,
            scene.view_time_offsets,
        )
        scene.release_pictures()  # the images keep the object in a file
        return initial

    def _begin(self, initial: InitialGaussians) -> None:
        self.iteration = 0
        self.parameters = {
            "means": torch.tensor(initial.means, dtype=torch.float32),
            "log_scales": torch.full((len(initial.means),), float(np.log(initial.scale))),
            "opacity_logits": torch.full((len(initial.means),), 1.0),
            "colour_logits": torch.logit(torch.tensor(initial.colours, dtype=torch.float32).clamp(0.02, 0.98)),
        }
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            self.network = self._network(torch.tensor(initial.centre), torch.tensor(initial.base_motion))
        self._start_optimiser()

    def _resume(self, state: dict) -> None:
        self.iteration = state["iteration"]
        self.parameters = state["parameters"]
        self.network = self._network(state["network"]["centre"], state["network"]["base_motion"])
        self.network.load_state_dict(state["network"])
        if self.formation is not None:
            self.formation.load_state_dict(state["formation"])
        self._start_optimiser()
        self.optimiser.load_state_dict(state["optimiser"])
        self.pairs = tuple(state["pairs"])

    def state(self) -> dict[str, Any]:
        """What a resumed fit needs, as tensors and plain values."""
        return {
            "identity": self.identity,
            "iteration": self.iteration,
            "parameters": {name: value.detach() for name, value in self.parameters.items()},
            "network": self.network.state_dict(),
            "formation": {} if self.formation is None else self.formation.state_dict(),
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

    def _image_formation(self, initial: InitialGaussians) -> ImageFormation:
        """Cameras and exposures that are not corrected yet. Steps are scaled by what the hulls show of the object."""
        scene = self.scene
        velocities = np.gradient(initial.base_motion, 1 / scene.fps, axis=0)[list(initial.frames)]
        surfaces = [hull.points[hull.surface] for hull in initial.hulls]
        surfaces = [points[:: max(1, len(points) // HULL_POINTS)] for points in surfaces]
        return ImageFormation(
            [scene.cameras[view] for view in scene.views],
            scene.frame_count,
            scene.fps,
            self.config.calibration,
            np.concatenate(surfaces),
            np.repeat(velocities, [len(points) for points in surfaces], axis=0),
            None if self.silhouettes is None else self.silhouettes.inconsistency,
        )

    @property
    def networks(self) -> Networks:
        """What moves the Gaussians and corrects the images."""
        return Networks(self.network, self.formation)

    def _start_optimiser(self) -> None:
        c, extent = self.config, self.half_extent
        rates = dict(
            zip(PARAMETER_NAMES, (c.means_rate * extent, c.scale_rate, c.opacity_rate, c.colour_rate), strict=True)
        )
        self.parameters = {name: value.requires_grad_() for name, value in self.parameters.items()}
        weights = [p for name, p in self.network.named_parameters() if name != "base_motion"]
        groups = [{"name": name, "params": [self.parameters[name]], "rate": rates[name]} for name in PARAMETER_NAMES]
        groups += [{"name": "weights", "params": weights, "rate": c.motion_rate}]
        groups += [{"name": "base_motion", "params": [self.network.base_motion], "rate": c.base_rate * extent}]
        if self.formation is not None:
            calibration, formation = c.calibration, self.formation
            groups += [{"name": "cameras", "params": [formation.pose], "rate": calibration.rate_px}]
            groups += [{"name": "exposures", "params": [formation.exposure], "rate": calibration.exposure_rate}]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)
        self._find_neighbours()

    def _find_neighbours(self) -> None:
        means = self.parameters["means"].detach().double().numpy()
        self.pairs = neighbour_pairs(means, self.config.neighbours)

    @property
    def frames(self) -> int:
        """How many frames are in the fit at this iteration."""
        c, count = self.config, self.scene.frame_count
        done = self.iteration / c.iterations - c.first_frame_fraction
        if done < 0:
            return 1
        return min(count, 2 + int(done / max(c.growth_fraction, 1e-9) * (count - 1)))

    @property
    def annealing(self) -> float:
        """0 until all frames are in, then up to 1: learning rates and the weight of the hulls decrease with it."""
        grown = self.config.first_frame_fraction + self.config.growth_fraction
        return max(0.0, (self.iteration / self.config.iterations - grown) / (1 - grown))

    @property
    def corrected(self) -> bool:
        """Whether cameras and exposures are refined at this iteration. At first the first frame settles alone."""
        c = self.config
        return c.refine_calibration and self.iteration >= c.calibration.start_fraction * c.iterations

    def canonical(self) -> Gaussians:
        """The Gaussians at frame 0, without gradients."""
        p = {name: value.detach() for name, value in self.parameters.items()}
        return Gaussians(
            p["means"], p["log_scales"].exp(), torch.sigmoid(p["opacity_logits"]), torch.sigmoid(p["colour_logits"])
        )

    def calibration(self) -> Calibration | None:
        """The cameras as they are corrected now; None if they are kept."""
        f = self.formation
        if f is None:
            return None
        return Calibration.of(self.scene, f.found(), f.pivot, f.points, since=self.by_silhouettes)

    def step(self) -> float:
        """One step of Adam on a batch of images; returns the loss."""
        c = self.config
        rng = np.random.default_rng((self.seed, 1 + self.iteration))
        chosen = self._choose_images(rng)
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * c.final_rate_factor**self.annealing
        if self.frames > 1:
            # Points that slide over the surface, or colours that change, explain a moving texture as well as motion
            # does, and faster: without this factor a spin would be tracked with a lag.
            for group in self.optimiser.param_groups:
                if group["name"] == "means" or (group["name"] == "colour_logits" and self.annealing == 0):
                    group["lr"] *= c.canonical_rate_factor
        parts = self.objective.parts(len(self.parameters["means"]), chosen, 1 - self.annealing, rng)
        value = self._compute_gradients(parts)
        if not np.isfinite(value):
            raise MasivError(
                f"reconstruct diverged at step {self.iteration} of {c.iterations}: lower reconstruct.motion_rate and "
                "reconstruct.means_rate"
            )
        self.optimiser.step()
        self._interpolate_base_motion()
        frames = self.frames
        self.iteration += 1
        if self.frames > frames:
            means = self.parameters["means"].detach()
            extrapolate_motion(self.network, means, self.frames - 1, c.motion_rate, rng)
        if self.iteration in self._pruning_steps():
            self._prune()
        return value

    def _interpolate_base_motion(self) -> None:
        """No image moves the knots of frames without a picture: they follow the spline through the others."""
        frames, count = self.scene.observed_frames, self.scene.frame_count
        if len(frames) < count:
            knots = self.network.base_motion.detach()
            filled = interpolated(frames, knots[list(frames)].double().numpy(), count)
            knots.copy_(torch.from_numpy(filled))

    def _compute_gradients(self, parts: tuple[Part, ...]) -> float:
        """Set the gradient of each parameter to the sum over ``parts``, in their order; returns the loss."""
        given, corrected = (self.objective, self.parameters, self.networks, self.pairs), self.corrected
        if self.worker is None:
            found = [gradients(*given, part, corrected=corrected) for part in parts]
        else:
            first, other = parts
            self.worker.submit(*given[1:], other, corrected=corrected)
            found = [gradients(*given, first, corrected=corrected), self.worker.result()]
        for parameter, *each in zip(parameters(self.parameters, self.networks), *(g for _, g in found), strict=True):
            known = [gradient for gradient in each if gradient is not None]
            parameter.grad = sum(known[1:], known[0]) if known else None
        self.network.hold_base_motion(self.frames)
        return sum(value for value, _ in found)

    def _choose_images(self, rng: np.random.Generator) -> list[tuple[int, int]]:
        """(frame, index of its image). One shows the newest frame while frames are added, the others random frames."""
        observed = [frame for frame in self.scene.observed_frames if frame < self.frames]
        chosen = rng.integers(len(observed), size=self.config.batch_size)
        if self.frames < self.scene.frame_count:
            chosen[0] = len(observed) - 1
        return [(observed[k], int(rng.integers(len(self.images[observed[k]])))) for k in chosen]

    def _pruning_steps(self) -> tuple[int, ...]:
        """Iterations: at the end of frame 0 alone, and twice while all frames are in."""
        n, c = self.config.iterations, self.config
        grown = c.first_frame_fraction + c.growth_fraction
        steps = [int(n * fraction) for fraction in (c.first_frame_fraction, grown, (1 + grown) / 2)]
        return tuple(step for step in steps if step < n)

    def _prune(self) -> None:
        """Remove transparent Gaussians and their optimiser state, and find neighbours again."""
        keep = torch.sigmoid(self.parameters["opacity_logits"].detach()) >= self.config.prune_opacity
        if int(keep.sum()) < 2:
            raise MasivError("reconstruct: every Gaussian became transparent; check the masks of the scene")
        for group, name in zip(self.optimiser.param_groups, PARAMETER_NAMES, strict=False):
            old = self.parameters[name]
            new = old.detach()[keep].clone().requires_grad_()
            moments = self.optimiser.state.pop(old, {})  # none if the objective does not depend on it
            self.optimiser.state[new] = {k: v[keep] if v.shape == old.shape else v for k, v in moments.items()}
            group["params"] = [new]
            self.parameters[name] = new
        self._find_neighbours()
