"""The layout of PhysTwin (Jiang et al., ICCV 2025): one case of its RGB-D recordings, as it is published.

``metadata.json`` contains intrinsics (a 3×3 [pixels] a camera, pixel centres at whole numbers), fps, WH, frame_num;
``calibrate.pkl`` a camera-to-world pose 4×4 [m] a camera, OpenCV axes. Pictures: ``color/CAMERA/FRAME.png`` with
``depth/CAMERA/FRAME.npy`` (millimetres, aligned with the colour; or .png). Masks: ``mask/CAMERA/OBJECT/FRAME.png`` with
the names of the objects in ``mask/mask_info_CAMERA.json``, or ``mask/CAMERA/FRAME.png``. World: metres, the calibration
board lies on the table at z = 0 and −z is up.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.scene.assemble import Conventions, assemble
from masiv.scene.camera import Camera
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.lens import HALF
from masiv.scene.listing import array, entries, mapping, number
from masiv.scene.numpy_pickle import load_arrays
from masiv.scene.pictures import PLAIN, MaskSource, Pictures, common_size
from masiv.scene.scene import Scene
from masiv.scene.transforms import count_frames, opengl_c2w_to_world_to_camera
from masiv.strict import read_json

METADATA, CALIBRATION = "metadata.json", "calibrate.pkl"
CONVENTIONS = Conventions(up="-z", ground_height=0.0)
TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
NUMBER = re.compile(r"^[0-9]{1,18}$")
HAND = "hand"
"""What PhysTwin calls the hand that moves the object."""
PICTURES, DEPTHS = (".png", ".jpg", ".jpeg"), (".npy", ".png")


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / METADATA).is_file() and (folder / CALIBRATION).is_file()


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for unusable calibration, metadata, pictures, depths or masks."""
    declaration = read_declaration(folder)
    metadata = mapping(read_json(folder / METADATA), str(folder / METADATA))
    intrinsics = _intrinsics(metadata, folder / METADATA)
    poses = _poses(folder / CALIBRATION, len(intrinsics))
    cameras, paths, depths, masks = [], {}, {}, {}
    problems: list[str] = []
    for view, (pinhole, pose) in enumerate(zip(intrinsics, poses, strict=True)):
        files = _numbered(folder / "color" / str(view), PICTURES)
        if not files:
            raise InputError(_no_pictures(folder, view))
        width, height = common_size(list(files.values()), f"camera {view} in {folder}")
        cameras.append(Camera(f"camera {view}", width, height, pinhole, pose))
        paths |= {(view, frame): path for frame, path in files.items()}
        found = _numbered(folder / "depth" / str(view), DEPTHS)
        depths |= {(view, frame): path for frame, path in found.items() if frame in files}
        masks |= {(view, frame): source for frame, source in _masks(folder, view, files, problems).items()}
    frame_count = count_frames({frame for _, frame in paths}, str(folder))
    pictures = Pictures(paths=paths, masks=masks, cameras=tuple(cameras), depths=depths)
    fps = declaration.fps or number(metadata, "fps", str(folder / METADATA))
    if fps <= 0:
        raise InputError(f"{folder / METADATA}: fps is {fps:g}, it must be positive")
    return assemble(
        folder, "PhysTwin", declaration, CONVENTIONS, pictures, fps=fps, frame_count=frame_count,
        problems=dict.fromkeys(problems),
    )  # fmt: skip


def _intrinsics(metadata: Mapping[str, Any], where: Path) -> list[np.ndarray]:
    matrices = []
    for k, rows in enumerate(entries(metadata.get("intrinsics"), f"{where}: 'intrinsics'", "camera")):
        matrices.append(array({"intrinsics": rows}, "intrinsics", ((3, 3),), f"{where}, camera {k}") + HALF)
    return matrices


def _poses(path: Path, count: int) -> list[np.ndarray]:
    """world_to_camera (4, 4) of each camera."""
    content = load_arrays(path)
    try:
        poses = np.array(content, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        poses = np.zeros(())
    if poses.shape != (count, 4, 4):
        raise InputError(f"{path} must contain a camera-to-world pose 4×4 for each of the {count} cameras")
    try:
        return [opengl_c2w_to_world_to_camera(pose @ TO_OPENGL) for pose in poses]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """The files FRAME.suffix of ``folder`` by frame; of two suffixes the first."""
    if not folder.is_dir():
        return {}
    found = [
        p
        for suffix in reversed(suffixes)
        for p in folder.glob(f"*{suffix}")
        if p.stem.isdecimal() and len(p.stem) <= 18 and p.is_file()
    ]
    return dict(sorted((int(path.stem), path) for path in found))


def _no_pictures(folder: Path, view: int) -> str:
    video = folder / "color" / f"{view}.mp4"
    target = folder / "color" / str(view)
    if video.is_file():
        return f"{target} has no pictures: make them of {video.name}, ffmpeg -i {video} -start_number 0 {target}/%d.png"
    return f"{target} has no pictures FRAME.png"


def _masks(folder: Path, view: int, files: dict[int, Path], problems: list[str]) -> dict[int, MaskSource]:
    source = _mask_folder(folder / "mask", view, problems)
    masks = _numbered(source, (".png",))
    if masks:
        lacking = sorted(set(files) - set(masks))
        if lacking:
            raise InputError(f"{source} has no mask of frame {lacking[0]}: it needs one for each picture")
        return {frame: MaskSource("mask", "mask pictures", masks[frame]) for frame in files}
    return dict.fromkeys(files, PLAIN)


def _mask_folder(masks: Path, view: int, problems: list[str]) -> Path:
    listing = masks / f"mask_info_{view}.json"
    if not listing.is_file():
        return masks / str(view)
    names = mapping(read_json(listing), str(listing))
    objects = [key for key, name in names.items() if name != HAND]
    if len(objects) != 1:
        raise InputError(
            f"{listing} names {len(objects)} objects ({', '.join(str(names[k]) for k in objects)}): leave one besides "
            f"'{HAND}'"
        )
    if len(objects) < len(names):
        problems.append(
            "a hand moves the object: its force is unknown to every law, so identify needs frames in which it lets go"
        )
    return masks / str(view) / objects[0]


LAYOUT = Layout("PhysTwin", f"{METADATA} with {CALIBRATION}", can_read, read)
