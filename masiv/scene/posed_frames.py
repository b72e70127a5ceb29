"""``transforms*.json``: pictures with a pose and a time each. Shared by the Blender and the nerfstudio layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.scene.assemble import Conventions, assemble
from masiv.scene.camera import Camera
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.depth import MILLIMETRE
from masiv.scene.lens import Lens, read_lens
from masiv.scene.listing import array, entries, mapping, number, text
from masiv.scene.pictures import OWN_ALPHA, PLAIN, MaskSource, Pictures, common_size, has_transparency, image_size
from masiv.scene.scene import Scene
from masiv.scene.transforms import TimeGrid, opengl_c2w_to_world_to_camera
from masiv.strict import read_json

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG")


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One entry of a listing. ``where`` names it in messages; ``time`` [s], negative for an empty background.

    depth: the depth picture, in steps of ``depth_unit`` [m].
    """

    path: Path
    mask: Path | None
    time: float
    world_to_camera: np.ndarray
    lens: Lens
    where: str
    depth: Path | None = None
    depth_unit: float = MILLIMETRE

    @cached_property
    def signature(self) -> np.ndarray:
        """Pose and intrinsics (25,), to compare cameras. Lengths in metres and in fractions of the picture."""
        scale = max(self.lens.width, self.lens.height)
        intrinsics = self.lens.intrinsics[:2].ravel() / scale
        shape = [self.lens.width, self.lens.height]
        return np.concatenate([self.world_to_camera[:3].ravel(), intrinsics, self.lens.coefficients, shape])


def read_listing(listing: Path) -> list[PosedPicture]:
    """The pictures that ``listing`` names. Raises InputError for an entry that cannot be used, naming it."""
    content = mapping(read_json(listing), str(listing))
    common = {key: value for key, value in content.items() if key != "frames"}
    rows = entries(content.get("frames"), f"{listing}: 'frames'", "picture")
    return [_picture(listing.parent, common, row, f"{listing}, frame {k}") for k, row in enumerate(rows)]


def posed_scene(
    folder: Path,
    layout: str,
    declaration: SceneDeclaration,
    conventions: Conventions,
    pictures: Sequence[PosedPicture],
    *,
    extra: Mapping[str, Sequence[PosedPicture]] | None = None,
    problems: Sequence[str] = (),
) -> Scene:
    """The scene of ``pictures``. Their times define the frames; pictures with the same pose and lens are one view.

    ``extra``: further pictures by the name of their listing, for example test views; those between frames are ignored.
    Raises InputError for uneven times and for two pictures of one view at one time.
    """
    problems = list(problems)
    observed = [p for p in pictures if p.time >= 0]
    if not observed:
        raise InputError(f"{folder}: no picture has a time of 0 or more")
    grid = TimeGrid.from_times([p.time for p in observed], [p.where for p in observed], declaration.fps)
    if declaration.fps is None and are_normalized([p.time for p in observed]):
        problems.append(
            f"the times run from exactly 0 to 1, as normalised ones do: taken as seconds ({grid.fps:g} fps); "
            "give fps in scene.yaml if they are not"
        )
    views = _Views([], {}, {})
    for picture in pictures:
        views.add(picture, grid.frame(picture.time))
    for name, more in (extra or {}).items():
        fitting = [p for p in more if p.time >= 0 and grid.frame(p.time) is not None]
        known = len(views.members)
        for picture in fitting:
            views.add(picture, grid.frame(picture.time))
        if len(fitting) < len(more):
            problems.append(f"{len(more) - len(fitting)} pictures of {name} are at times between the frames: left out")
        if len(views.members) > known:
            added = " ".join(f"--holdout-camera {view}" for view in range(known, len(views.members)))
            problems.append(f"the cameras of {name} are read as all others: to keep them away from a fit, {added}")
    return assemble(
        folder,
        layout,
        declaration,
        conventions,
        views.pictures(),
        fps=grid.fps,
        frame_count=grid.count,
        problems=problems,
    )


def are_normalized(times: Sequence[float]) -> bool:
    """Whether ``times`` run from exactly 0 to exactly 1, as those of D-NeRF, which are not seconds."""
    return min(times) == 0 and max(times) == 1


def _near(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(one - other).max() <= 1e-5)


@dataclass
class _Views:
    """Pictures sorted into views: ``at`` by (view, frame), and the empty ``backgrounds`` by view."""

    members: list[list[PosedPicture]]
    at: dict[tuple[int, int], PosedPicture]
    backgrounds: dict[int, Path]

    def add(self, picture: PosedPicture, frame: int | None) -> None:
        signature = picture.signature
        same = (v for v, members in enumerate(self.members) if _near(members[0].signature, signature))
        view = next(same, len(self.members))
        if view == len(self.members):
            self.members.append([])
        if frame is None:  # before time 0
            if self.backgrounds.setdefault(view, picture.path) != picture.path:
                raise InputError(
                    f"{picture.where} is a second picture of its view before time 0: one is the empty background, "
                    "the motion begins at 0"
                )
        elif (other := self.at.get((view, frame))) is None:
            self.at[view, frame] = picture
        elif other.path != picture.path:
            raise InputError(f"{picture.where} has the pose and the time of {other.where}: two pictures of one view")
        self.members[view].append(picture)

    def pictures(self) -> Pictures:
        cameras, lenses, cut_out = [], {}, set()
        for view, members in enumerate(self.members):
            first = members[0]
            name = self._name(view)
            common_size([p.path for p in members], name)
            try:
                intrinsics = first.lens.pinhole
            except InputError as error:
                raise InputError(f"{first.where}: {error}") from error
            cameras.append(Camera(name, first.lens.width, first.lens.height, intrinsics, first.world_to_camera))
            if not first.lens.is_pinhole:
                lenses[view] = first.lens
            mine = [p.path for key, p in self.at.items() if key[0] == view]
            if not mine:
                raise InputError(f"{first.where}: its view has only an empty background (a time below 0)")
            if has_transparency(mine[0]):
                cut_out.add(view)
        return Pictures(
            paths={key: picture.path for key, picture in self.at.items()},
            masks={key: self._mask_source(key[0], picture, key[0] in cut_out) for key, picture in self.at.items()},
            cameras=tuple(cameras),
            lenses=lenses,
            backgrounds=self.backgrounds,
            depths={key: picture.depth for key, picture in self.at.items() if picture.depth is not None},
            depth_unit=self._depth_unit(),
        )

    def _depth_unit(self) -> float:
        units = {p.depth_unit: p for p in self.at.values() if p.depth is not None}
        if len(units) > 1:
            (one, a), (other, b), *_ = units.items()
            raise InputError(f"depth_unit_scale_factor is {one:g} at {a.where} and {other:g} at {b.where}: give one")
        return next(iter(units), MILLIMETRE)

    def _name(self, view: int) -> str:
        """The folder, if it contains the pictures of this view only, else the name of the first picture."""
        parents = {p.path.parent for p in self.members[view]}
        others = {p.path.parent for v, members in enumerate(self.members) if v != view for p in members}
        if len(self.members) > 1 and len(parents) == 1 and not parents & others:
            return next(iter(parents)).name
        return self.members[view][0].path.stem

    def _mask_source(self, view: int, picture: PosedPicture, has_alpha: bool) -> MaskSource:
        if has_alpha:
            return OWN_ALPHA
        if picture.mask is not None:
            return MaskSource("mask", "mask pictures (mask_path)", picture.mask)
        if view in self.backgrounds:
            return MaskSource("background", "difference from the view's picture before time 0")
        return PLAIN


def _picture(folder: Path, common: Mapping[str, Any], row: Any, where: str) -> PosedPicture:
    row = {**common, **mapping(row, where)}
    name = text(row, "file_path", where)
    path = _existing(folder, name, where)
    if "time" not in row:
        raise InputError(f"{where} ({name}) has no 'time': each picture needs its time")
    try:
        pose = opengl_c2w_to_world_to_camera(array(row, "transform_matrix", ((4, 4), (3, 4)), where))
    except InputError as error:
        raise InputError(str(error) if where in str(error) else f"{where}: {error}") from error
    mask = _existing(folder, text(row, "mask_path", where), where) if row.get("mask_path") else None
    depth = _existing(folder, text(row, "depth_file_path", where), where) if row.get("depth_file_path") else None
    unit = number(row, "depth_unit_scale_factor", where, MILLIMETRE)
    if unit <= 0:
        raise InputError(f"{where}: depth_unit_scale_factor is {unit:g}, it is a length in metres")
    lens = read_lens(row, *image_size(path), where)
    return PosedPicture(path, mask, number(row, "time", where), pose, lens, where, depth, unit)


def _existing(folder: Path, name: str, where: str) -> Path:
    for suffix in SUFFIXES:
        path = folder / f"{name}{suffix}"
        if path.is_file():
            return path
    raise InputError(f"{folder / name}, which {where} names, is missing")
