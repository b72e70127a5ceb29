"""How near drawn Gaussians are to the pictures of a scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from masiv import metrics
from masiv.progress import Progress, silent
from masiv.report.draw import drawn, on_black, over
from masiv.scene.scene import Frame, Scene
from masiv.splat.gaussians import Gaussians
from masiv.subsample import evenly_spread

MAX_PICTURES = 400
"""Pictures that a mean is of, at most. Of 400 independent ones it has a standard error of a twentieth of their scatter;
large recordings have thousands, and a picture of two megapixels takes a good part of a second."""

GaussiansAt = Callable[[int], Gaussians]
"""The Gaussians at a frame."""


@dataclass(frozen=True)
class PictureScores:
    """PSNR, SSIM and mask IoU of drawn Gaussians against the observed object, by (view, frame)."""

    by_picture: Mapping[tuple[int, int], Mapping[str, float]]

    def mean(self, views: Sequence[int], frames: Sequence[int]) -> dict[str, Any] | None:
        """Over the pictures of ``views`` and ``frames`` that were measured, with the lists of both and, for each frame,
        the PSNR of the box; None if there is none."""
        measured = sorted({frame for _, frame in self.by_picture} & set(frames))
        chosen = {key: score for key, score in self.by_picture.items() if key[0] in views and key[1] in measured}
        scores = [score for score in chosen.values() if score]
        if not scores:
            return None
        names = sorted({name for score in scores for name in score})
        means = {name: float(np.mean([score[name] for score in scores if name in score])) for name in names}
        boxes = {
            frame: [s.get("psnr_box_db", np.nan) for (_, of), s in chosen.items() if of == frame and s]
            for frame in measured
        }
        curve = [float(np.mean(own)) if own else None for own in boxes.values()]
        return {"views": list(views), "frames": measured, **means, "psnr_box_db_by_frame": curve}


def score_pictures(
    scene: Scene, models: Mapping[str, GaussiansAt], frames: Sequence[int], *, progress: Progress = silent
) -> dict[str, PictureScores]:
    """Of each of ``models``, over all cameras of as many of ``frames``, evenly spread, as make ``MAX_PICTURES``.

    A picture is read once for all models. Pixels that an occluder hides are black on both sides. A picture that is
    missing has no scores.
    """
    frames = evenly_spread(frames, MAX_PICTURES // max(len(scene.cameras), 1))
    out: dict[str, dict[tuple[int, int], dict[str, float]]] = {name: {} for name in models}
    for done, frame in enumerate(frames):
        progress("measure pictures", done, len(frames))
        gaussians = {name: at(frame) for name, at in models.items()}
        for view in range(len(scene.cameras)):
            observed = scene.frame(view, frame)
            for name, own in gaussians.items():
                out[name][view, frame] = _scores(scene, view, observed, own)
    if frames:
        progress("measure pictures", len(frames), len(frames))
    return {name: PictureScores(own) for name, own in out.items()}


def _scores(scene: Scene, view: int, observed: Frame, gaussians: Gaussians) -> dict[str, float]:
    if not observed.valid.any():
        return {}
    colours, alpha = drawn(gaussians, scene.cameras[view])
    colours[~observed.valid] = 0
    share = (observed.mask * observed.valid)[..., None]
    score = metrics.picture_scores(over(colours, alpha), on_black(observed.image, share[..., 0]), observed.mask)
    plate = scene.background(view)
    box = metrics.mask_box(observed.mask)
    if plate is not None and box is not None:
        # On black, half a pixel of outline outweighs all that is inside of it; a viewer sees the object in its scene.
        seen = np.round(observed.image[box] * share[box] + plate[box] * (1 - share[box])).astype(np.uint8)
        placed = over(colours[box], alpha[box], plate[box])
        hidden = ~observed.valid[box]
        placed[hidden] = seen[hidden]
        score["psnr_box_in_scene_db"] = metrics.psnr(placed, seen)
    score["mask_iou"] = metrics.mask_iou(alpha * observed.valid, share[..., 0])
    return score
