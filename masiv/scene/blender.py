"""Blender's layout as NeRF's synthetic scenes and D-NeRF (Pumarola et al., CVPR 2021) have it, with a time a picture.

``transforms_train.json`` (``_val``, ``_test``): camera_angle_x [rad] and frames {file_path without extension, time,
transform_matrix 4×4, OpenGL}. Alpha is the mask. World: z up; nothing is said of a ground. Times are seconds, unless
fps in scene.yaml says how long a frame lasts.
"""

from __future__ import annotations

from pathlib import Path

from masiv.scene.assemble import Conventions
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.posed_frames import posed_scene, read_listing
from masiv.scene.scene import Scene

LOOKED_FOR = "transforms_train.json"
CONVENTIONS = Conventions(up="z", ground_height=None, up_assumed=True)
SPLITS = ("transforms_val.json", "transforms_test.json")


def recognises(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / LOOKED_FOR).is_file()


def read(folder: Path, declaration: SceneDeclaration) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    extra = {name: read_listing(folder / name) for name in SPLITS if (folder / name).is_file()}
    pictures = read_listing(folder / LOOKED_FOR)
    return posed_scene(folder, "blender", declaration, CONVENTIONS, pictures, extra=extra)
