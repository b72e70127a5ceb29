"""Reading pictures and masks from files, whatever the layout."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.scene import depth_masks, masks
from masiv.scene.background import BackgroundModel, learn_background
from masiv.scene.camera import Camera
from masiv.scene.depth import MILLIMETRE, DepthNoise, depth_size, read_depth
from masiv.scene.lens import Lens
from masiv.scene.picture_file import png_size, read_raw
from masiv.scene.scene import Frame
from masiv.scene.segmenter import Prompt, Segmentation, VideoSegmenter
from masiv.subsample import evenly_spread

OCCLUDER_ALPHA = 50
MAX_LEARNT, MAX_LEARNT_A_VIEW = 48, 6
"""Pictures from which the noise and the light of a recording are learnt, in all and of one view."""
ESTIMATED = ("background", "plain", "segmenter")
"""Kinds of masks that are estimated from colours."""
Key = tuple[int, int]  # camera index, frame


@dataclass(frozen=True)
class MaskSource:
    """The source of a picture's mask; ``description`` is for messages.

    alpha: the fourth channel of ``path``, or of the picture itself. mask: ``path`` is white on the object. cutout:
    ``path`` has all but the object painted white. background: difference from the view's empty background. plain:
    difference from the border's colour. depth: what is nearer than the view's empty scene. segmenter: SAM 2.
    """

    kind: Literal["alpha", "mask", "cutout", "background", "plain", "depth", "segmenter"]
    description: str
    path: Path | None = None


PLAIN = MaskSource("plain", "plain background")
OWN_ALPHA = MaskSource("alpha", "alpha channel of the pictures")
DEPTH = MaskSource("depth", "depth, nearer than that of the empty scene")


@dataclass(frozen=True)
class Pictures:
    """Files of pictures and masks, read as the pinhole ``cameras`` see them.

    By camera: ``lenses`` to undistort; ``backgrounds``, pictures of the empty scene; ``occluders``, pictures with
    positive alpha on what hides the scene; ``crops`` (H, W) bool, False outside of the declared crop box.
    ``depths``: depth pictures in steps of ``depth_unit`` [m], with ``depth_noise``; ``empty_depths``, by camera, of the
    empty scene. ``segmenter``: makes the masks of that kind; ``boxes`` (x0, y0, x1, y1) [pixels], by camera, are around
    the object in its first picture.
    """

    paths: dict[Key, Path]
    masks: dict[Key, MaskSource]
    cameras: tuple[Camera, ...]
    lenses: dict[int, Lens] = field(default_factory=dict)
    backgrounds: dict[int, Path] = field(default_factory=dict)
    occluders: dict[int, Path] = field(default_factory=dict)
    crops: tuple[np.ndarray, ...] | None = None
    depths: dict[Key, Path] = field(default_factory=dict)
    empty_depths: dict[int, Path] = field(default_factory=dict)
    depth_unit: float = MILLIMETRE
    depth_noise: DepthNoise = field(default_factory=DepthNoise)
    segmenter: VideoSegmenter | None = None
    boxes: dict[int, tuple[float, float, float, float]] = field(default_factory=dict)

    def with_segmenter(
        self, segmenter: VideoSegmenter, boxes: dict[int, tuple[float, float, float, float]]
    ) -> Pictures:
        """With masks by ``segmenter`` in place of those that would be estimated from colours.

        Raises InputError if there are none, if the segmenter is not there, or if nothing marks the object in a view.
        """
        chosen = {key for key, source in self.masks.items() if source.kind in ESTIMATED}
        if not chosen:
            raise InputError(
                f"scene.yaml: masks.segmenter has nothing to do, the masks are given ({self.mask_sources()[0]}): "
                "remove the key masks, or the given masks"
            )
        segmenter.check()
        unmarked = {view for view, _ in chosen} - boxes.keys() - self.backgrounds.keys()
        if unmarked:
            names = ", ".join(self.cameras[view].name for view in sorted(unmarked))
            raise InputError(
                f"scene.yaml: masks.boxes lacks {names}, of which there is no picture without the object: "
                "give the box [x0, y0, x1, y1] around the object in the first picture, in pixels"
            )
        source = MaskSource("segmenter", f"SAM 2 ({segmenter.weights.name})")
        masks = {key: source if key in chosen else known for key, known in self.masks.items()}
        return replace(self, masks=masks, segmenter=segmenter, boxes=boxes)

    def load(self, view: int, frame: int, mask: np.ndarray | None = None) -> Frame:
        """The picture of ``view`` at ``frame``. One that does not exist is black, and not valid anywhere.

        mask (H, W) float32: of this picture, if it is known.
        Raises InputError if a file cannot be read or its size differs from that of its view.
        """
        camera = self.cameras[view]
        path = self.paths.get((view, frame))
        if path is None:
            return _missing_frame(camera.height, camera.width, with_depth=bool(self.depths))
        image = self._read(view, path)
        if self.masks[view, frame] == OWN_ALPHA and image.shape[-1] != 4:
            raise InputError(
                f"{path} has no alpha channel, unlike other pictures of {camera.name}: its mask is unknown"
            )
        depth = self._depth(view, self.depths.get((view, frame))) if self.depths else None
        if mask is None:
            mask = self._mask(view, frame, image, depth)
            if self.crops is not None:
                mask = mask * self.crops[view]
        valid = np.ones(image.shape[:2], bool)
        if view in self.lenses:
            valid &= self.lenses[view].visible
        if view in self.occluders:
            occluder = self._read(view, self.occluders[view])
            if occluder.shape[-1] == 4:
                valid &= occluder[..., 3] <= OCCLUDER_ALPHA
        if depth is not None:
            depth = np.where(valid, depth, np.float32(0))
        return Frame(image[..., :3], mask, valid, depth)

    def background(self, view: int) -> np.ndarray | None:
        """The empty scene in ``view``, (H, W, 3) uint8, or None if there is no picture of it."""
        return self._read(view, self.backgrounds[view])[..., :3] if view in self.backgrounds else None

    def mask_inputs(self) -> list[Any]:
        """What the masks depend on, besides code: files by name, size and time of their last change, and lenses."""
        named = [("picture", *key, path) for key, path in self.paths.items()]
        named += [(mask.kind, *key, mask.path) for key, mask in self.masks.items()]
        named += [("depth", *key, path) for key, path in self.depths.items()]
        for kind in ("backgrounds", "occluders", "empty_depths"):
            named += [(kind, view, -1, path) for view, path in getattr(self, kind).items()]
        if self.segmenter is not None:
            named += [("weights", -1, -1, path) for path in self.segmenter.files()]
        files = [[kind, view, frame, *_file_state(path)] for kind, view, frame, path in named]
        return [files, self.cameras, self.lenses]

    def mask_sources(self) -> tuple[str, list[str]]:
        """The description of the main source of the masks, and a problem for each other source."""
        kinds: dict[str, list[str]] = {}
        for key, path in self.paths.items():
            kinds.setdefault(self.masks[key].description, []).append(path.name)
        main, *others = sorted(kinds, key=lambda kind: -len(kinds[kind]))
        problems = [f"{len(kinds[o])} pictures ({kinds[o][0]}, …) take their mask from {o}" for o in others]
        if any(read_pixels(p).shape[-1] != 4 for p in self.occluders.values()):
            problems.append("the occluder pictures (frame −2) have no alpha channel and are ignored")
        return main, problems

    def depth_problems(self) -> list[str]:
        """What the depth pictures lack. Raises InputError for one that has another size than its camera."""
        for key, path in (*self.depths.items(), *(((view, -1), path) for view, path in self.empty_depths.items())):
            camera, size = self.cameras[key[0]], depth_size(path)
            if size != (camera.width, camera.height):
                raise InputError(
                    f"{path} is {size[0]}×{size[1]}, the pictures of {camera.name} are {camera.width}×{camera.height}: "
                    "align the depth pictures with the colour pictures"
                )
        lacking = [path.name for key, path in self.paths.items() if key not in self.depths]
        problems = []
        if self.depths and lacking:
            problems.append(f"{len(lacking)} of {len(self.paths)} pictures ({lacking[0]}, …) have no depth")
        if self.depths and len(self.cameras) == 1:
            problems.append(
                "one camera: the side of the object that it does not see is a guess, as deep as the silhouette is wide"
            )
        return problems

    def _depth(self, view: int, path: Path | None) -> np.ndarray:
        """Depth (H, W) [m] as the pinhole camera sees it, 0 where it is unknown."""
        camera = self.cameras[view]
        if path is None:
            return np.zeros((camera.height, camera.width), np.float32)
        depth = read_depth(path, self.depth_unit)
        return self.lenses[view].undistort_nearest(depth) if view in self.lenses else depth

    def _mask(self, view: int, frame: int, image: np.ndarray, depth: np.ndarray | None) -> np.ndarray:
        source = self.masks[view, frame]
        other = None if source.path is None else self._read(view, source.path)
        colour = np.ascontiguousarray(image[..., :3])
        if source.kind == "alpha":
            pixels = image if other is None else other
            return pixels[..., 3 if pixels.shape[-1] == 4 else 0].astype(np.float32) / 255
        if source.kind == "mask" and other is not None:
            return _as_mask(other)
        if source.kind == "cutout" and other is not None:
            return masks.from_white(other[..., :3], colour)
        if source.kind == "background":
            return self._background_model.mask(view, colour)
        if source.kind == "segmenter":
            return self._segmentation.mask(view, frame)
        if source.kind == "depth" and depth is not None:
            return depth_masks.from_empty_depth(depth, self._depth(view, self.empty_depths[view]), self.depth_noise)
        return masks.from_plain_background(colour)

    @cached_property
    def _segmentation(self) -> Segmentation:
        assert self.segmenter is not None
        return Segmentation(self.segmenter, self._frames_of("segmenter"), self._image, self._prompt)

    def _prompt(self, view: int) -> Prompt:
        """The declared box, or box and points of the difference from the empty scene."""
        if view in self.boxes:
            return Prompt(self.boxes[view], np.empty((0, 2)))
        first = self._frames_of("segmenter")[view][0]
        found = Prompt.of_mask(self._background_model.mask(view, self._image(view, first)))
        if found is None:
            raise InputError(
                f"{self.paths[view, first]} does not differ from the picture without the object: replace one of them, "
                f"or give the box around the object in scene.yaml, masks.boxes.{self.cameras[view].name}"
            )
        return found

    def _image(self, view: int, frame: int) -> np.ndarray:
        return np.ascontiguousarray(self._read(view, self.paths[view, frame])[..., :3])

    def _frames_of(self, *kinds: str) -> dict[int, list[int]]:
        """Frames whose mask is of one of these ``kinds``, ascending, by view."""
        frames: dict[int, list[int]] = {}
        for (view, frame), source in sorted(self.masks.items(), key=lambda item: item[0]):
            if source.kind in kinds:
                frames.setdefault(view, []).append(frame)
        return frames

    @cached_property
    def _background_model(self) -> BackgroundModel:
        """Learnt from some pictures of each view whose mask, or its prompt, is the difference from the empty scene."""
        found = self._frames_of("background", "segmenter")
        frames = {view: known for view, known in found.items() if view in self.backgrounds and view not in self.boxes}
        count = min(MAX_LEARNT_A_VIEW, max(2, MAX_LEARNT // len(frames)))
        chosen = {view: evenly_spread(known, count) for view, known in frames.items()}
        images = {
            view: [self._read(view, self.paths[view, frame])[..., :3] for frame in known]
            for view, known in chosen.items()
        }
        return learn_background(images, {view: self._read(view, self.backgrounds[view])[..., :3] for view in frames})

    def _read(self, view: int, path: Path) -> np.ndarray:
        pixels = read_pixels(path)
        height, width = pixels.shape[:2]
        camera = self.cameras[view]
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{path} is {width}×{height}, the other pictures of its view are {camera.width}×{camera.height}"
            )
        return self.lenses[view].undistort(pixels) if view in self.lenses else pixels


def _file_state(path: Path | None) -> list[str | int]:
    if path is None:
        return []
    stat = path.stat()
    return [path.resolve().as_posix(), stat.st_size, stat.st_mtime_ns]


def read_pixels(path: Path) -> np.ndarray:
    """The picture (H, W, 3) RGB or (H, W, 4) RGBA, uint8. Raises InputError if the file is not a picture."""
    raw = read_raw(path)
    if raw.dtype == np.uint16:
        raw = (raw // 256).astype(np.uint8)
    if raw.dtype != np.uint8:
        raise InputError(f"{path} has {raw.dtype} pixels: give pictures with 8 or 16 bits a channel")
    if raw.ndim == 2:
        return np.repeat(raw[..., None], 3, axis=-1)
    return cv2.cvtColor(raw, cv2.COLOR_BGR2RGB if raw.shape[-1] == 3 else cv2.COLOR_BGRA2RGBA)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height [pixels], from the header if the file is a PNG."""
    size = png_size(path)
    if size is not None:
        return size
    height, width = read_raw(path).shape[:2]
    return width, height


def common_size(paths: list[Path], of_what: str) -> tuple[int, int]:
    """Width and height [pixels] that all ``paths`` share. Raises InputError if they differ."""
    sizes = {image_size(path): path for path in paths}
    if len(sizes) > 1:
        listed = ", ".join(f"{path.name} {w}×{h}" for (w, h), path in sizes.items())
        raise InputError(f"pictures of {of_what} differ in size: {listed}")
    return next(iter(sizes))


def has_transparency(path: Path) -> bool:
    """Whether the picture has an alpha channel that is not opaque everywhere."""
    pixels = read_pixels(path)
    return pixels.shape[-1] == 4 and bool((pixels[..., 3] < 255).any())


def crop_mask(camera: Camera, corners: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) bool a box with ``corners`` (8, 3) [m] covers; all if it reaches behind the camera."""
    pixels, depth = camera.project(corners)
    if depth.min() <= 1e-6:
        return np.ones((camera.height, camera.width), bool)
    hull = cv2.convexHull(np.clip(pixels, -1e6, 1e6).astype(np.int32))
    return cv2.fillConvexPoly(np.zeros((camera.height, camera.width), np.uint8), hull, 1).astype(bool)


def _as_mask(pixels: np.ndarray) -> np.ndarray:
    """Mask from a mask picture: its alpha if that varies, else its brightness. Values of 0 and 1 mean 0 and 255."""
    alpha_varies = pixels.shape[-1] == 4 and (pixels[..., 3] != pixels[0, 0, 3]).any()
    values = (pixels[..., 3] if alpha_varies else pixels[..., :3].max(axis=-1)).astype(np.float32)
    return values if values.max() <= 1 else values / 255


@cache
def _missing_frame(height: int, width: int, *, with_depth: bool) -> Frame:
    shape = height, width
    depth = np.zeros(shape, np.float32) if with_depth else None
    return Frame(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.zeros(shape, bool), depth)
