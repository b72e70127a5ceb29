"""Displacement of every point of the object at time t: a low-rank motion field (MASIV: mu_t = mu* + w(mu*, t) B(t))."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch

from masiv.errors import InputError
from masiv.files import read_safetensors, write_safetensors
from masiv.strict import reason


class DeformationNetwork(torch.nn.Module):
    """Displacement d(x, t) = s(t) - s(0) + sum_b w_b(x, t) (B_b(t) - B_b(0)) of a point that is at x at frame 0.

    s is a cubic spline through ``base_motion``, the object's translation at each frame; the bases B add the rest.
    Two things differ from MASIV. d(x, 0) = 0 by construction: the canonical shape is the shape at frame 0. The motion
    can be evaluated between frames: activations are smooth, and the highest frequency of the time encoding is half of
    the Nyquist frequency of the frames.

    The base motion is learnable. The translation of a frame is well observed, and a network that had to correct errors
    of a fixed base motion would oscillate from frame to frame.

    centre (3,) [m] and half_extent [m] scale positions to about [-1, 1]; base_motion (T, 3) [m], T = frame_count >= 2;
    fps [1/s]; bases = B; width and depth of the hidden layers; octaves of the positional encodings (time_octaves is an
    upper limit, see ``time_octave_limit``). Raises InputError for values that are not finite or do not match.
    """

    centre: torch.Tensor
    spline: torch.Tensor

    def __init__(
        self,
        *,
        centre: torch.Tensor,
        half_extent: float,
        frame_count: int,
        fps: float,
        base_motion: torch.Tensor,
        bases: int = 10,
        width: int = 64,
        depth: int = 2,
        space_octaves: int = 3,
        time_octaves: int = 6,
    ) -> None:
        super().__init__()
        base_motion = torch.as_tensor(base_motion, dtype=torch.float32)
        if frame_count < 2 or base_motion.shape != (frame_count, 3):
            raise InputError(
                f"a motion needs 2 frames or more and one base motion a frame: got {frame_count} frames and "
                f"base motion of shape {tuple(base_motion.shape)}"
            )
        if not (half_extent > 0 and fps > 0 and torch.isfinite(base_motion).all()):
            raise InputError(
                f"a motion needs a positive extent and fps and a finite base motion: got {half_extent} m, {fps} fps"
            )
        time_octaves = min(time_octaves, time_octave_limit(frame_count))
        self.settings = {
            "half_extent": float(half_extent),
            "frame_count": int(frame_count),
            "fps": float(fps),
            "bases": int(bases),
            "width": int(width),
            "depth": int(depth),
            "space_octaves": int(space_octaves),
            "time_octaves": int(time_octaves),
        }
        self.register_buffer("centre", torch.as_tensor(centre, dtype=torch.float32).reshape(3).clone())
        self.register_buffer("spline", _natural_spline(frame_count).float(), persistent=False)
        self.base_motion = torch.nn.Parameter(base_motion.clone())
        time_size = 1 + 2 * time_octaves
        self.motion = _mlp(time_size, width, depth, 4 * bases)
        self.space_input = torch.nn.Linear(3 + 6 * space_octaves, width)
        self.time_input = torch.nn.Linear(time_size, width, bias=False)
        self.coefficients = _mlp(width, width, depth - 1, bases)
        # No motion at first: the bases are zero. The weights differ, so that the bases can become different.
        last = self.motion[-1]
        assert isinstance(last, torch.nn.Linear)
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)

    @property
    def frame_count(self) -> int:
        """Frames T of the motion."""
        return self.settings["frame_count"]

    @property
    def fps(self) -> float:
        """Frames per second [1/s]."""
        return self.settings["fps"]

    def forward(self, positions: torch.Tensor, time: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Frame-0 positions (N, 3) [m] at ``time`` [s] -> displacement (N, 3) [m] and change of log scale (N,)."""
        moved = self._evaluate(positions, positions.new_tensor([float(time)]))[0]
        return moved[:, :3], moved[:, 3]

    def displacements(self, positions: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        """Frame-0 positions (N, 3) [m] at ``times`` (K,) [s] -> displacements (K, N, 3) [m]."""
        times = torch.as_tensor(times, dtype=positions.dtype, device=positions.device)
        return self._evaluate(positions, times)[..., :3]

    def changes(self, positions: torch.Tensor, times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``forward`` at ``times`` (K,) [s]: displacements (K, N, 3) [m] and changes of log scale (K, N)."""
        moved = self._evaluate(positions, times)
        return moved[..., :3], moved[..., 3]

    def base_displacements(self, times: torch.Tensor) -> torch.Tensor:
        """Displacement (K, 3) [m] of the base motion at ``times`` (K,) [s]."""
        return self._base(times * self.fps) - self.base_motion[0]

    def hold_base_motion(self, first: int) -> None:
        """Set the gradient of the base motion from frame ``first`` on to zero, so that a step leaves it as it is.

        The spline passes a minute part of the gradient of one frame on to all others, with alternating signs, and Adam
        makes a step of full length of it. The base motion of frames that no image has moved yet would wander off.
        """
        if self.base_motion.grad is not None:
            self.base_motion.grad[first:] = 0.0

    def _evaluate(self, positions: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        """(N, 3), (K,) -> (K, N, 4): displacement [m] and change of log scale."""
        s = self.settings
        tau = times * (s["fps"] / (s["frame_count"] - 1))
        encoded = _encode(tau[:, None], s["time_octaves"])
        rest = _encode(torch.zeros_like(tau[:1, None]), s["time_octaves"])
        basis = (self.motion(encoded) - self.motion(rest)).reshape(len(times), s["bases"], 4)
        x = (positions - self.centre) / s["half_extent"]
        hidden = self.space_input(_encode(x, s["space_octaves"]))[None] + self.time_input(encoded)[:, None]
        weights = self.coefficients(torch.nn.functional.silu(hidden))
        moved = weights @ basis
        return torch.cat(
            [moved[..., :3] * s["half_extent"] + self.base_displacements(times)[:, None], moved[..., 3:]], dim=-1
        )

    def _base(self, frames: torch.Tensor) -> torch.Tensor:
        """The cubic spline through the base motion at fractional frames (K,) -> (K, 3) [m]."""
        knots = self.base_motion
        second = self.spline @ knots
        left = frames.detach().floor().long().clamp(0, self.frame_count - 2)
        b = (frames - left)[:, None]
        a = 1 - b
        curve = ((a**3 - a) * second[left] + (b**3 - b) * second[left + 1]) / 6
        return a * knots[left] + b * knots[left + 1] + curve

    def save(self, path: Path) -> None:
        """Write the network to ``path`` (safetensors; the settings are in its metadata)."""
        write_safetensors(path, self.state_dict(), {"masiv_deformation": json.dumps(self.settings)})

    @classmethod
    def load(cls, path: Path) -> DeformationNetwork:
        """Read what ``save`` wrote. Raises InputError if ``path`` is missing or another file."""
        try:
            arrays, metadata = read_safetensors(path)
            settings = json.loads(metadata["masiv_deformation"])
            tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
            network = cls(centre=tensors["centre"], base_motion=tensors["base_motion"], **settings)
            network.to(tensors["base_motion"].dtype).load_state_dict(tensors)
        except (InputError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(
                f"{path} is not a motion saved by masiv ({reason(error, path)}); run reconstruct again"
            ) from error
        return network


def time_octave_limit(frame_count: int) -> int:
    """How many octaves sin(2^k pi tau), tau in [0, 1] over ``frame_count`` frames, are below half of Nyquist.

    Octave k has 2^k / 2 periods over the frames, and the Nyquist limit is (T - 1) / 2. The other half is left for the
    harmonics that the hidden layers add.
    """
    return max(0, math.floor(math.log2((frame_count - 1) / 2)) + 1)


def _encode(x: torch.Tensor, octaves: int) -> torch.Tensor:
    """Positional encoding [x, sin(2^k pi x), cos(2^k pi x)], k < octaves, on the last axis."""
    scaled = x[..., None] * (math.pi * 2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device))
    return torch.cat([x, scaled.sin().flatten(-2), scaled.cos().flatten(-2)], dim=-1)


def _mlp(inputs: int, width: int, depth: int, outputs: int) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    for _ in range(depth):
        layers += [torch.nn.Linear(inputs, width), torch.nn.SiLU()]
        inputs = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(inputs, outputs))


def _natural_spline(count: int) -> torch.Tensor:
    """The matrix (T, T), float64, from values at unit knots to second derivatives of the natural cubic spline."""
    system = torch.eye(count, dtype=torch.float64)
    right = torch.zeros(count, count, dtype=torch.float64)
    for i in range(1, count - 1):
        system[i, i - 1 : i + 2] = torch.tensor([1.0, 4.0, 1.0], dtype=torch.float64)
        right[i, i - 1 : i + 2] = torch.tensor([6.0, -12.0, 6.0], dtype=torch.float64)
    return torch.linalg.solve(system, right)
