"""The layout of nerfstudio and instant-ngp, with a time for each picture.

``transforms.json`` contains a camera, for all pictures or for each: fl_x, fl_y, cx, cy, w, h [pixels], k1, k2, p1, p2,
camera_model (or camera_angle_x [rad]); and frames: {file_path, transform_matrix 4×4 [m], camera to world, OpenGL axes,
time [s], mask_path?, depth_file_path?}. Depth pictures have 16 bits, in steps of ``depth_unit_scale_factor`` [m], a
millimetre unless given. The mask is alpha, else mask_path (white on the object), else the difference from the view's
picture before time 0. Pictures are undistorted when they are read. World: metres, z up, no ground.
"""

from __future__ import annotations

from pathlib import Path

from masiv.scene.assemble import Conventions
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.listing import mapping
from masiv.scene.posed_frames import posed_scene, read_listing
from masiv.scene.scene import Scene
from masiv.strict import read_json

LISTING = "transforms.json"
CONVENTIONS = Conventions(up="z", ground_height=None, up_assumed=True)
FROM_STRUCTURE = ("applied_transform", "applied_scale", "ply_file_path")


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / LISTING).is_file()


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    declaration, listing = read_declaration(folder), folder / LISTING
    pictures = read_listing(listing)
    problems = []
    if any(key in mapping(read_json(listing), str(listing)) for key in FROM_STRUCTURE):
        problems.append(
            "the poses come from structure from motion, whose unit of length and up axis are arbitrary: "
            "check the cameras' positions in metres"
        )
    return posed_scene(folder, "nerfstudio", declaration, CONVENTIONS, pictures, problems=problems)


LAYOUT = Layout("nerfstudio", "transforms.json", can_read, read)
