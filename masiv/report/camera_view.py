"""Pictures for the page's view through the cameras: observed, reconstructed and drawn from the twin, a frame each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from masiv.errors import MasivError
from masiv.metrics import content_box, mask_box
from masiv.report.draw import draw, on_black
from masiv.report.follow import Binding
from masiv.report.motion_view import shown_instants
from masiv.report.page import encoded
from masiv.runfolder import RunFolder
from masiv.scene.scene import Scene

if TYPE_CHECKING:
    from masiv.splat.dynamic import DynamicGaussians

Box = tuple[slice, slice]
"""Rows and columns of a picture."""
VIEWS = 4
MAX_BYTES = 900_000
"""Of all cameras together, before base64."""
SETTINGS = ((360, 85), (360, 70), (240, 75), (180, 70), (120, 60))
"""Largest height of a picture [px] and quality of WebP; the first that is small enough."""


def shown_views(run: RunFolder, scene: Scene) -> list[int]:
    """Held-out cameras first, then training cameras, evenly over their order."""
    training = [view for view in range(len(scene.cameras)) if view not in run.holdout_cameras]
    held_out = list(run.holdout_cameras)[:VIEWS]
    count = min(VIEWS - len(held_out), len(training))
    return held_out + [training[k * len(training) // count] for k in range(count)]


def camera_data(run: RunFolder, scene: Scene, dynamic: DynamicGaussians, rollout: np.ndarray) -> list[dict[str, Any]]:
    """What report.js shows of ``shown_views``. rollout (T, Q, 3) [m] covers every frame; the frames are those of
    ``shown_instants``. ``reconstruction`` is null where a frame was not fitted."""
    views = shown_views(run, scene)
    frames = [int(frame) for frame in shown_instants(scene.frame_count)]
    binding = Binding.at_rest(dynamic.at(0.0), rollout[0])
    found = []
    for view in views:
        role = "kept out of the fit" if view in run.holdout_cameras else "seen by the fit"
        series, box = _series(run, scene, dynamic, binding, rollout, view, frames)
        height, width = (part.stop - part.start for part in box)
        encoded_series = _encoded(series, box, MAX_BYTES // len(views))
        name = f"Camera {view} ({scene.cameras[view].name}), {role}"
        found.append({"name": name, "width": width, "height": height, **encoded_series})
    return found


@dataclass(frozen=True)
class Cut:
    """A picture that is black but for ``content`` (H, W, 3) uint8, with the first row and column of that: of large
    pictures of a small object many can be held."""

    content: np.ndarray
    row: int
    column: int

    @classmethod
    def of(cls, picture: np.ndarray) -> Cut:
        rows, columns = content_box(picture) or (slice(0, 0), slice(0, 0))
        return cls(picture[rows, columns].copy(), rows.start, columns.start)

    def within(self, box: Box) -> np.ndarray:
        """The part ``box`` of the whole picture."""
        rows, columns = box
        out = np.zeros((rows.stop - rows.start, columns.stop - columns.start, 3), np.uint8)
        height, width = self.content.shape[:2]
        top, left = max(self.row, rows.start), max(self.column, columns.start)
        bottom, right = min(self.row + height, rows.stop), min(self.column + width, columns.stop)
        if bottom > top and right > left:
            own = self.content[top - self.row : bottom - self.row, left - self.column : right - self.column]
            out[top - rows.start : bottom - rows.start, left - columns.start : right - columns.start] = own
        return out


def _series(
    run: RunFolder, scene: Scene, dynamic: DynamicGaussians, binding: Binding, rollout: np.ndarray, view: int,
    frames: Sequence[int],
) -> tuple[dict[str, list[Cut | None]], Box]:  # fmt: skip
    """Pictures of the object on black, and the part where it ever is."""
    camera = scene.cameras[view]
    series: dict[str, list[Cut | None]] = {"observed": [], "reconstruction": [], "twin": []}
    ever = np.zeros((camera.height, camera.width), np.float32)
    for frame in frames:
        observed = scene.frame(view, frame)
        simulated, alpha = draw(binding.moved(rollout[frame]), camera)
        ever = np.maximum(ever, np.maximum(observed.mask, alpha))
        series["observed"].append(Cut.of(on_black(observed.image, observed.mask)))
        fitted = frame < run.fit_frames
        series["reconstruction"].append(Cut.of(draw(dynamic.at(frame / scene.fps), camera)[0]) if fitted else None)
        series["twin"].append(Cut.of(simulated))
    rows, columns = mask_box(ever, margin=6) or (slice(0, camera.height), slice(0, camera.width))
    return series, (
        slice(rows.start, min(rows.stop, camera.height)),
        slice(columns.start, min(columns.stop, camera.width)),
    )


def _encoded(series: dict[str, list[Cut | None]], box: Box, budget: int) -> dict[str, list[str | None]]:
    """WebP of the part ``box`` as data of a page, small enough for ``budget`` [bytes] if a setting allows."""
    files: dict[str, list[bytes | None]] = {}
    for height, quality in SETTINGS:
        files = {
            name: [None if cut is None else _webp(cut.within(box), height, quality) for cut in cuts]
            for name, cuts in series.items()
        }
        if sum(len(file) for pictures in files.values() for file in pictures if file) <= budget:
            break
    return {
        name: [None if file is None else f"data:image/webp;base64,{encoded(file)}" for file in pictures]
        for name, pictures in files.items()
    }


def _webp(picture: np.ndarray, height: int, quality: int) -> bytes:
    if picture.shape[0] > height:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    fine, data = cv2.imencode(".webp", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not fine:
        raise MasivError("a picture of the report could not be encoded as WebP")
    return data.tobytes()
