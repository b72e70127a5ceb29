"""Dense motion of the filled continuum (MASIV, section "Continuum Trajectory Estimation").

A copy of the deformation network of ``reconstruct`` moves the particles that fill frame 0. The network, not the
particles, is fine-tuned until they fill every other frame. d(x, 0) = 0 by construction, so frame 0 does not change.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from masiv.checkpoint import Checkpoint
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.consistency import images_against
from masiv.continuum.density_field import even_points
from masiv.continuum.fill import FilledVolume, density_field, fill_later_frame, hull_volume
from masiv.continuum.finetune import fine_tune
from masiv.errors import InputError, MasivError
from masiv.files import check_motion, read_npz, write_npz
from masiv.hull.carve import visual_hull
from masiv.hull.silhouette import silhouettes
from masiv.hull.symmetry import MirrorPlane, contradicting, mirror_plane, symmetric_hull
from masiv.hull.velocity import with_velocities
from masiv.hull.volume import VolumePrior, volume_prior
from masiv.progress import Progress, silent
from masiv.scene.scene import Scene
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.strict import reason
from masiv.subsample import evenly_spread

_CHUNK = 8
"""Times that are evaluated together: limits the memory."""
_HULLS = 5
"""Frames whose hulls tell the volume."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of the continuum.

    positions (T, Q, 3) float32 [m, world] at times (T,) [s]; positions[0] is the canonical frame. Each particle has
    the volume spacing³ [m³]; volume = Q spacing³ [m³]. ``network`` gives the motion between the frames. volume_log_sd:
    standard deviation of the volume's logarithm, by the cameras' view of random shapes; NaN if it is not known. mirror:
    plane of symmetry at frame 0 that the filling used, None if it used none.
    """

    positions: np.ndarray
    times: np.ndarray
    spacing: float
    volume: float
    network: DeformationNetwork
    volume_log_sd: float = math.nan
    mirror: MirrorPlane | None = None

    def evaluate(self, times: np.ndarray) -> np.ndarray:
        """Positions (K, Q, 3) float32 [m] at any ``times`` (K,) [s] within the observed span."""
        return positions_at(self.network, self.positions[0], times)

    def save(self, path: Path) -> None:
        """Write ``path`` (.npz): positions, times, spacing, volume and the network, completely or not at all."""
        weights = {f"network/{name}": value.detach().numpy() for name, value in self.network.state_dict().items()}
        mirror = {} if self.mirror is None else {"mirror": [*self.mirror.normal, self.mirror.offset]}
        write_npz(
            path,
            positions=self.positions,
            times=self.times,
            spacing=self.spacing,
            volume=self.volume,
            volume_log_sd=self.volume_log_sd,
            network_settings=json.dumps(self.network.settings),
            **mirror,
            **weights,
        )

    @classmethod
    def load(cls, path: Path) -> Trajectory:
        """Read what ``save`` wrote. Raises InputError if ``path`` is missing or another file."""
        try:
            file = read_npz(path)
            weights = {n.removeprefix("network/"): torch.from_numpy(file[n]) for n in file if n.startswith("network/")}
            settings = json.loads(str(file["network_settings"]))
            network = DeformationNetwork(
                centre=weights["centre"], base_motion=weights["base_motion"], **settings
            ).requires_grad_(False)
            network.load_state_dict(weights)
            log_sd = float(file["volume_log_sd"]) if "volume_log_sd" in file else math.nan
            spacing, volume = float(file["spacing"]), float(file["volume"])
            plane = file.get("mirror")
            mirror = None if plane is None else MirrorPlane(plane[:3], float(plane[3]))
            check_motion(file["positions"], file["times"])
            if not (0 < spacing < math.inf and 0 < volume < math.inf):
                raise ValueError(f"spacing {spacing:g} m, volume {volume:g} m³")
            return cls(file["positions"], file["times"], spacing, volume, network, log_sd, mirror)
        except (InputError, KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
            raise InputError(
                f"{path} is not a trajectory saved by masiv ({reason(error, path)}): start a new run with --out"
            ) from error


def estimate_trajectory(
    scene: Scene,
    dynamic: DynamicGaussians,
    config: TrajectoryConfig,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress = silent,
) -> Trajectory:
    """Fill frame 0 and estimate the motion of its particles over all frames of ``scene``.

    Held-out views are not used. Raises MasivError if a frame has no volume to fill or the motion becomes non-finite.
    """
    checkpoint = checkpoint or Checkpoint(None)
    scene = with_velocities(scene, dynamic.base_positions(scene.times))
    progress("volume", 0, 1)
    prior = known_volume(scene, config)
    mirror = first_mirror(scene, config, progress)
    start = fill_first_frame(scene, dynamic, config, prior, mirror)
    hull = hull_volume(scene, config)
    same = None if prior is None else replace(prior, volume=start.volume)
    volumes = []
    for frame in range(1, scene.frame_count):
        progress("fill", frame, scene.frame_count - 1)
        volumes.append(fill_later_frame(scene, dynamic, frame, config, start, hull, same))
    network = fine_tune(scene, dynamic, start, volumes, config, seed=seed, checkpoint=checkpoint, progress=progress)
    positions = positions_at(network, start.points, scene.times)
    if not np.isfinite(positions).all():
        raise MasivError("trajectory: the motion became non-finite; lower trajectory.learning_rate")
    log_sd = math.nan if prior is None else prior.log_sd
    return Trajectory(positions, scene.times, start.spacing, start.volume, network, log_sd, mirror)


def known_volume(scene: Scene, config: TrajectoryConfig) -> VolumePrior | None:
    """The prior of the object's volume from hulls of some frames; None if depth or points measure the surface."""
    if scene.load_cloud is not None or scene.depth_noise is not None:
        return None
    chosen = evenly_spread(scene.observed_frames, _HULLS)
    return volume_prior(scene, {k: visual_hull(scene, k, resolution=config.fill_resolution) for k in chosen})


def first_mirror(scene: Scene, config: TrajectoryConfig, progress: Progress = silent) -> MirrorPlane | None:
    """The mirror plane of the object at frame 0 that ``config.symmetry`` asks for; None if there is none.

    Raises InputError if the silhouettes contradict a plane that is given, or there are none. A plane that was searched
    for is dropped then.
    """
    given = config.symmetry if isinstance(config.symmetry, tuple) else None
    if config.symmetry == "none":
        return None
    if scene.load_cloud is not None:
        if given is None:
            return None
        raise InputError(f"trajectory.symmetry: {scene.path} has point clouds, which no hull surrounds: set it to none")
    hull = visual_hull(scene, 0, resolution=config.fill_resolution)
    progress("symmetry", 0, 1)
    plane = mirror_plane(hull, None if given is None else np.array(given))
    tighter = symmetric_hull(hull, plane)
    against = contradicting(silhouettes(scene, 0, config.fill_resolution), hull, tighter)
    if against and given is not None:
        raise InputError(
            f"trajectory.symmetry: the masks of view {against[0]} at frame 0 contradict a mirror plane with the normal "
            f"{list(given)}: give another one, auto or none"
        )
    ratio = tighter.volume / hull.volume
    progress("symmetry", 1, 1, "no mirror plane" if against else f"{plane}, {ratio:.2f} of the hull's volume")
    return None if against else plane


def fill_first_frame(
    scene: Scene,
    dynamic: DynamicGaussians,
    config: TrajectoryConfig,
    prior: VolumePrior | None = None,
    mirror: MirrorPlane | None = None,
) -> FilledVolume:
    """The canonical continuum: frame 0 filled, without the points whose motion leaves the masks of later frames.

    Carving over time uses the silhouettes of all frames. Corners of the hull that no camera can exclude at frame 0 are
    outside of a silhouette as soon as the object has turned or touched the ground. prior: of the object's volume. Masks
    and motion have errors, so it takes more images to remove a point if less than a probable volume would be left.
    mirror: plane of symmetry of the object at frame 0.
    """
    field = density_field(scene, dynamic, 0, config, prior=prior, mirror=mirror)
    solid = np.argwhere(field.density > 0.5)
    voxels = field.lower + field.spacing * solid
    against = images_against(scene, dynamic.deformation, voxels, config)
    limit = config.carve_images
    while prior is not None and (against < limit).sum() * field.spacing**3 < prior.lower and (against >= limit).any():
        limit += config.carve_images
    kept = against < limit
    field.density[tuple(solid[~kept].T)] = 0.0
    if not kept.any():
        raise MasivError("trajectory: the motion moves the whole object out of its masks; run reconstruct for longer")
    spacing = (field.volume / config.particle_count) ** (1 / 3)
    points = even_points(field, spacing)
    return FilledVolume(points, spacing, len(points) * spacing**3)


def positions_at(network: DeformationNetwork, start: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Positions (K, Q, 3) float32 [m] at ``times`` (K,) [s] of the points that are at ``start`` (Q, 3) at frame 0."""
    points = torch.as_tensor(np.asarray(start), dtype=torch.float32)
    chunks = torch.as_tensor(np.asarray(times), dtype=torch.float32).split(_CHUNK)
    with torch.no_grad():
        moved = [points + network.displacements(points, chunk) for chunk in chunks]
    return torch.cat(moved).numpy()
