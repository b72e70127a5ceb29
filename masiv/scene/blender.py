"""The Blender layout of NeRF's synthetic scenes and of D-NeRF (Pumarola et al., CVPR 2021).

``transforms_train.json`` (``_val``, ``_test``) contains camera_angle_x [rad] and frames: {file_path without extension,
time [s], transform_matrix 4×4 [m], camera to world, OpenGL axes}. Times have another unit if scene.yaml gives fps.
Alpha is the mask. World: metres, z up, no ground.
"""

from __future__ import annotations

from pathlib import Path

from masiv.scene.assemble import Conventions
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.posed_frames import posed_scene, read_listing
from masiv.scene.scene import Scene

LISTING = "transforms_train.json"
CONVENTIONS = Conventions(up="z", ground_height=None, up_assumed=True)
SPLITS = ("transforms_val.json", "transforms_test.json")


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / LISTING).is_file()


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    extra = {name: read_listing(folder / name) for name in SPLITS if (folder / name).is_file()}
    pictures = read_listing(folder / LISTING)
    return posed_scene(folder, "blender", read_declaration(folder), CONVENTIONS, pictures, extra=extra)


LAYOUT = Layout("Blender", "transforms_train.json", can_read, read)
