"""The surface of a body as a sequence of OBJ files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from masiv.export.ply import frame_name
from masiv.export.surface import surfaces
from masiv.files import atomic_folder
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    from masiv.simulation.rollout import Rollout


def write_obj_sequence(
    rollout: Rollout, folder: str | Path, *, spacing: float | None = None, progress: Progress = silent
) -> None:
    """Write ``folder``/frame_0000.obj …: the surface of each frame, with normals, in the axes of the world [m].

    spacing [m]: see ``reconstruct_surface``. Vertices and triangles differ from frame to frame. Raises InputError if
    ``folder`` holds something, pysplashsurf is missing, or the particles have no surface.
    """
    import trimesh

    with atomic_folder(Path(folder)) as temporary:
        for frame, surface in enumerate(surfaces(rollout.positions, spacing)):
            mesh = trimesh.Trimesh(
                surface.vertices, surface.triangles, vertex_normals=surface.normals, process=False, validate=False
            )
            mesh.export(temporary / frame_name(frame, "obj"), include_normals=True)
            progress("export", frame + 1, len(rollout.positions))
