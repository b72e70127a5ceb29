"""The one way in: ``read_scene``."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from masiv.errors import InputError
from masiv.scene import blender, nerfstudio, pacnerf, springgaus_real, springgaus_synthetic
from masiv.scene.declaration import SceneDeclaration, read_declaration
from masiv.scene.scene import Scene


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


def read_scene(path: str | Path) -> Scene:
    """Read the scene at ``path``, whatever its layout, with the ``scene.yaml`` beside it.

    Raises InputError where nothing is recognised or what is there cannot be used; lesser troubles are in ``problems``.
    """
    path = Path(path)
    is_sequence = path.is_file() and springgaus_real.recognises(path)
    if not path.is_dir() and not is_sequence:
        raise InputError(f"{path} is not a folder: give the folder of a scene")
    for layout in LAYOUTS.values():
        if layout.recognises(path):
            return layout.read(path, read_declaration(path.parent if is_sequence else path))
    looked = "; ".join(f"{layout.LOOKED_FOR} ({name})" for name, layout in LAYOUTS.items())
    raise InputError(f"{path} has no known scene layout: looked for {looked}")
