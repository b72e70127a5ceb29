"""The one way in: ``read_scene``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from masiv.errors import InputError
from masiv.scene import pacnerf
from masiv.scene.declaration import SceneDeclaration, read_declaration
from masiv.scene.scene import Scene

# layout -> (the files that tell it, test, reader)
LAYOUTS: dict[str, tuple[str, Callable[[Path], bool], Callable[[Path, SceneDeclaration], Scene]]] = {
    "pacnerf": (pacnerf.LOOKED_FOR, pacnerf.recognises, pacnerf.read),
}


def read_scene(path: str | Path) -> Scene:
    """Read the scene in folder ``path``, whatever its layout, with the ``scene.yaml`` beside it.

    Raises InputError where nothing is recognised or what is there cannot be used; lesser troubles are in ``problems``.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder of a scene")
    for _, recognises, read in LAYOUTS.values():
        if recognises(folder):
            return read(folder, read_declaration(folder))
    looked = "; ".join(f"{files} ({name})" for name, (files, _, _) in LAYOUTS.items())
    raise InputError(f"{folder} has no known scene layout: looked for {looked}")
