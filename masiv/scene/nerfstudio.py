"""nerfstudio's and instant-ngp's layout, with a time a picture.

``transforms.json``: fl_x, fl_y, cx, cy, w, h, k1, k2, p1, p2, camera_model (or camera_angle_x), for all pictures or
for each; frames {file_path, transform_matrix 4×4 OpenGL, time [s], mask_path?}. Alpha is the mask, else mask_path,
white on the object, else the difference from the view's picture before time 0, where there is one. Pictures are
undistorted when they are read. World: z up; nothing is said of a ground.
"""

from __future__ import annotations

from pathlib import Path

from masiv.scene.assemble import Conventions
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.listing import mapping, read_json
from masiv.scene.posed_frames import posed_scene, read_listing
from masiv.scene.scene import Scene

LOOKED_FOR = "transforms.json"
CONVENTIONS = Conventions(up="z", ground_height=None, up_assumed=True)
FROM_STRUCTURE = ("applied_transform", "applied_scale", "ply_file_path")


def recognises(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / LOOKED_FOR).is_file()


def read(folder: Path, declaration: SceneDeclaration) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    listing = folder / LOOKED_FOR
    pictures = read_listing(listing)
    problems = []
    if any(key in mapping(read_json(listing), str(listing)) for key in FROM_STRUCTURE):
        problems.append(
            "the poses come from structure from motion, whose unit of length and up axis are arbitrary: "
            "check the cameras' positions in metres"
        )
    return posed_scene(folder, "nerfstudio", declaration, CONVENTIONS, pictures, problems=problems)
