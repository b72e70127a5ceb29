"""The one way in: ``read_scene``."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from masiv.errors import InputError
from masiv.scene import blender, nerfstudio, pacnerf, springgaus_real, springgaus_synthetic
from masiv.scene.declaration import SceneDeclaration, read_declaration
from masiv.scene.scene import Scene
from masiv.tracks import read as tracks_layout
from masiv.tracks.tracks import Tracks


class Layout(Protocol):
    """A module that reads one layout. ``LOOKED_FOR`` says by which files it is known."""

    @property
    def LOOKED_FOR(self) -> str: ...

    def recognises(self, folder: Path, /) -> bool: ...

    def read(self, folder: Path, declaration: SceneDeclaration, /) -> Scene: ...


LAYOUTS: dict[str, Layout] = {
    "PAC-NeRF": pacnerf,
    "Spring-Gaus synthetic": springgaus_synthetic,
    "Spring-Gaus real": springgaus_real,
    "nerfstudio": nerfstudio,
    "Blender": blender,
}


def read_observation(path: str | Path) -> Scene | Tracks:
    """Read what is at ``path``: pictures or tracks. Errors as of ``read_scene``."""
    folder = Path(path)
    return tracks_layout.read_tracks(folder) if tracks_layout.recognises(folder) else read_scene(folder)


def read_scene(path: str | Path) -> Scene:
    """Read the scene of pictures at ``path``, whatever its layout, with the ``scene.yaml`` beside it.

    Raises InputError where nothing is recognised or what is there cannot be used; lesser troubles are in ``problems``.
    """
    path = Path(path)
    if tracks_layout.recognises(path):
        raise InputError(f"{path} is a scene of tracks: this needs one of pictures")
    is_sequence = path.is_file() and springgaus_real.recognises(path)
    if not path.is_dir() and not is_sequence:
        raise InputError(f"{path} is not a folder: give the folder of a scene")
    for layout in LAYOUTS.values():
        if layout.recognises(path):
            return layout.read(path, read_declaration(path.parent if is_sequence else path))
    known = {**LAYOUTS, "tracks": tracks_layout}
    looked = "; ".join(f"{layout.LOOKED_FOR} ({name})" for name, layout in known.items())
    raise InputError(f"{path} has no known scene layout: looked for {looked}")
