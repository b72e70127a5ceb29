"""Masks by a video segmenter: SAM 2 (Ravi et al. 2024), as the library ``transformers`` has it.

The object is pointed at in the first picture of a view, with a box and some points on it. The segmenter follows it from
picture to picture and remembers the last ones, so a mask depends on the pictures before it and on none after it. The
processor of ``transformers`` is not used: it needs torchvision, for the scaling of pictures and points that is here.
"""

from __future__ import annotations

import importlib.util
import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from masiv.errors import InputError

POINTS = 3
"""Points on the object in the first picture of a view, besides the box, if its mask there is known."""
_CORNERS, _ON_OBJECT = (2, 3), 1
"""Labels of a box's corners and of points on the object, as SAM 2 numbers them."""
_MEAN, _SD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's pictures, by channel, black is 0 and white 1: the units of what SAM 2 was trained on."""
_STEPS = 255
"""Masks are multiples of 1/255: a step is far below what the probabilities are worth."""


@dataclass(frozen=True)
class Prompt:
    """Where the object is in the first picture of a view.

    box (x0, y0, x1, y1) [pixels], edges of pixels are whole numbers; points (P, 2) [pixels] on the object.
    """

    box: tuple[float, float, float, float]
    points: np.ndarray

    @classmethod
    def of_mask(cls, mask: np.ndarray, count: int = POINTS) -> Prompt | None:
        """Around ``mask`` (H, W) in [0, 1], with points deep inside of it; None if it is empty.

        A point is the pixel that is farthest from the outline and from the points before it.
        """
        inside = np.pad(mask > 0.5, 1)
        if not inside.any():
            return None
        rows, columns = np.nonzero(inside)
        box = (columns.min() - 1.0, rows.min() - 1.0, float(columns.max()), float(rows.max()))
        points = []
        while len(points) < count and inside.any():
            distance = np.asarray(ndimage.distance_transform_edt(inside))
            row, column = np.unravel_index(int(distance.argmax()), distance.shape)
            points.append((column - 0.5, row - 0.5))
            inside[row, column] = False
        return cls(box, np.array(points))


class VideoSegmenter:
    """SAM 2 with the weights in the folder ``weights``, loaded when the first mask is asked for.

    Pickled without the network: another process loads it again.
    """

    def __init__(self, weights: Path) -> None:
        self.weights = weights
        self._model: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {"weights": self.weights, "_model": None}

    def check(self) -> None:
        """Raises InputError if the library or the weights are not there."""
        if importlib.util.find_spec("transformers") is None:
            raise InputError(
                "scene.yaml: masks.segmenter is sam2, whose library is not installed: pip install 'masiv[segment]'"
            )
        config = self.weights / "config.json"
        if not config.is_file():
            raise InputError(
                f"scene.yaml: masks.weights: {self.weights} has no config.json: give the folder of a SAM 2 model, as "
                "saved by transformers, for example a copy of facebook/sam2.1-hiera-tiny"
            )
        try:
            kind = json.loads(config.read_text(encoding="utf-8")).get("model_type")
        except (OSError, ValueError, AttributeError) as error:
            raise InputError(f"scene.yaml: masks.weights: {config} cannot be read ({error}): copy it again") from error
        if kind != "sam2_video":
            raise InputError(
                f"scene.yaml: masks.weights: {config} is of a model of type {kind!r}: give one of type 'sam2_video'"
            )

    def files(self) -> list[Path]:
        """The files of the weights."""
        return sorted(path for path in self.weights.iterdir() if path.is_file())

    @property
    def model(self) -> Any:
        """The network, ``transformers.Sam2VideoModel``. Raises InputError as ``check``, and for incomplete weights."""
        if self._model is None:
            self.check()
            from transformers import Sam2VideoModel  # pyright: ignore[reportMissingImports]
            from transformers.utils import logging  # pyright: ignore[reportMissingImports]

            logging.disable_progress_bar()
            try:
                loaded: Any = Sam2VideoModel.from_pretrained(
                    self.weights, local_files_only=True, output_loading_info=True
                )
            except Exception as error:  # each kind of damage has its own exception
                reason = " ".join(str(error).split())
                raise InputError(f"scene.yaml: masks.weights: {self.weights} cannot be loaded: {reason}") from error
            model, report = loaded
            lacking = sorted(report["missing_keys"])
            if lacking:  # it would be filled with random numbers
                raise InputError(
                    f"scene.yaml: masks.weights: {self.weights} lacks {len(lacking)} of the network's weights "
                    f"({lacking[0]}, …): copy the whole model"
                )
            self._model = model.eval()
        return self._model

    def track(self, prompt: Prompt) -> Track:
        """The object that ``prompt`` marks in the first picture that is given to the track."""
        return Track(self.model, prompt)


class Track:
    """One object in the pictures of one view, given one after the other."""

    def __init__(self, model: Any, prompt: Prompt) -> None:
        import torch
        from transformers import Sam2VideoInferenceSession  # pyright: ignore[reportMissingImports]

        self._model = model
        self._prompt = prompt
        self._session = Sam2VideoInferenceSession(dtype=torch.float32)
        self._object = self._session.obj_id_to_idx(0)
        self.count = 0
        """Pictures that were given."""

    def mask(self, image: np.ndarray) -> np.ndarray:
        """The mask (H, W) uint8 of the next ``image`` (H, W, 3) uint8: 255 times the probability of the object."""
        import torch

        height, width = image.shape[:2]
        with torch.inference_mode():
            if self.count == 0:
                self._point_at_object(width, height)
            pixels = _network_input(image, self._model.config.image_size)
            found = self._model(self._session, frame=pixels, frame_idx=self.count)
            logits = torch.nn.functional.interpolate(
                found.pred_masks.float(), (height, width), mode="bilinear", antialias=True
            )
            mask = (_STEPS * torch.sigmoid(logits[0, 0])).round().to(torch.uint8).numpy()
        self._forget()
        self.count += 1
        return mask

    def _point_at_object(self, width: int, height: int) -> None:
        import torch

        marks = np.concatenate([np.reshape(self._prompt.box, (2, 2)), self._prompt.points.reshape(-1, 2)])
        # The network's coordinates are those of the resized picture, with the centre of a pixel at a whole number.
        marks = marks * (self._model.config.image_size / np.array([width, height])) - 0.5
        labels = [*_CORNERS, *[_ON_OBJECT] * len(self._prompt.points)]
        inputs = {
            "point_coords": torch.tensor(marks, dtype=torch.float32)[None, None],
            "point_labels": torch.tensor(labels, dtype=torch.int32)[None, None],
        }
        self._session.add_point_inputs(self._object, 0, inputs)
        self._session.obj_with_new_inputs = [0]

    def _forget(self) -> None:
        """Drop what no later picture needs; a session keeps the pictures and some megabytes of each of them."""
        config, outputs = self._model.config, self._session.output_dict_per_obj[self._object]
        assert self._session.processed_frames is not None
        self._session.processed_frames.clear()
        for kept in outputs.values():
            if self.count in kept:
                del kept[self.count]["high_res_masks"]
        reach = max(config.num_maskmem, config.max_object_pointers_in_encoder)
        outputs["non_cond_frame_outputs"].pop(self.count - reach, None)


class Segmentation:
    """The masks of a recording by ``segmenter``.

    frames: of each view that has masks of this kind, ascending. read(view, frame): the picture (H, W, 3) uint8.
    prompt(view): where the object is in the view's first picture. Pictures are read up to the one whose mask is asked
    for, so those of held-out frames stay unread. Masks that were made are kept, compressed, also for another process.
    """

    def __init__(
        self,
        segmenter: VideoSegmenter,
        frames: Mapping[int, Sequence[int]],
        read: Callable[[int, int], np.ndarray],
        prompt: Callable[[int], Prompt],
    ) -> None:
        self.segmenter = segmenter
        self.frames = frames
        self.read = read
        self.prompt = prompt
        self._masks: dict[tuple[int, int], tuple[bytes, tuple[int, ...]]] = {}
        self._tracks: dict[int, Track] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_tracks": {}}

    def mask(self, view: int, frame: int) -> np.ndarray:
        """The mask (H, W) float32 in [0, 1]. Raises InputError if the segmenter cannot be loaded."""
        while (view, frame) not in self._masks:
            if view not in self._tracks:
                self._tracks[view] = self.segmenter.track(self.prompt(view))
            track = self._tracks[view]
            current = self.frames[view][track.count]
            found = track.mask(self.read(view, current))
            self._masks[view, current] = zlib.compress(found.tobytes()), found.shape
        stored, shape = self._masks[view, frame]
        return np.frombuffer(zlib.decompress(stored), np.uint8).reshape(shape).astype(np.float32) / _STEPS


def _network_input(image: np.ndarray, side: int) -> Any:
    """The tensor (1, 3, side, side) that SAM 2 was trained on: resized, in units of ImageNet's standard deviations."""
    import torch

    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None].float() / 255
    pixels = torch.nn.functional.interpolate(pixels, (side, side), mode="bilinear", antialias=True)
    mean, std = (torch.tensor(values)[:, None, None] for values in (_MEAN, _SD))
    return (pixels - mean) / std
