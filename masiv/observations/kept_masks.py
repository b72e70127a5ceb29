"""Estimated masks that are kept in a folder, so that they are estimated once and not in every process.

Two kinds of files, each with the masks of one frame at most, so that a stage reads those of the frames that it may see:
``view_V_F.npz`` has what one picture shows, ``agreed_D_F.npz`` the masks of all views after they were made consistent;
D is a digest of cameras and views, which differ between stages. Masks are float32 and come back bit by bit.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.files import read_npz, write_npz
from masiv.observations.identity import content_hash, source_digest
from masiv.scene.frame_cache import Frame, FrameCache
from masiv.scene.scene import CorrectMasks, MaskedReader, Scene

CODE = ("scene", "hull")
"""Packages that estimate masks: if their code changes, masks are estimated again."""


@dataclass(frozen=True)
class KeptMasks:
    """Masks in ``folder``, of pictures and code with the digest ``key``. Other files and damaged ones do not count."""

    folder: Path
    key: str

    def read(self, name: str) -> dict[int, np.ndarray] | None:
        """The masks (H, W) float32 that were written under ``name``, by view; None if they have to be estimated."""
        path = self.folder / f"{name}.npz"
        if not path.is_file():
            return None
        try:
            file = read_npz(path)
            if str(file.pop("key")) == self.key:
                return {int(view): mask for view, mask in file.items()}
            reason = "is of other pictures, settings or code"
        except (InputError, ValueError, KeyError):
            reason = "is damaged"
        warnings.warn(f"what {self.folder} keeps of masks {reason}: they are estimated again", stacklevel=2)
        return None

    def write(self, name: str, masks: Mapping[int, np.ndarray]) -> None:
        """Keep ``masks`` (H, W) float32 by view under ``name``, compressed without loss."""
        arrays: dict[str, Any] = {str(view): mask for view, mask in masks.items()}
        write_npz(self.folder / f"{name}.npz", key=self.key, **arrays)


def with_kept_masks(scene: Scene, folder: Path) -> Scene:
    """``scene`` with estimated masks that are read from ``folder`` and written to it; as it is if masks are given.

    Masks are the same with and without the folder. They are remade, with a warning, if a picture, scene.yaml or the
    code is another, or a file is damaged.
    """
    if scene.mask_inputs is None or scene.load_with_mask is None:
        return scene
    kept = KeptMasks(folder, content_hash([scene.mask_inputs(), source_digest(*CODE)])[:32])
    read = scene.load.load if isinstance(scene.load, FrameCache) else scene.load
    correct = scene.correct_masks
    return replace(
        scene,
        load=FrameCache(partial(_load, kept, read, scene.load_with_mask)),
        correct_masks=None if correct is None else partial(_agreed, kept, correct),
    )


def _load(kept: KeptMasks, read, with_mask: MaskedReader, view: int, frame: int) -> Frame:
    """As ``read(view, frame)``, with the mask that is kept."""
    name = f"view_{view}_{frame:04d}"
    found = kept.read(name)
    if found is not None:
        return with_mask(view, frame, found[view])
    picture = read(view, frame)
    kept.write(name, {view: picture.mask})
    return picture


def _agreed(kept: KeptMasks, correct: CorrectMasks, scene: Scene, frame: int) -> Mapping[int, Frame]:
    """As ``correct(scene, frame)``, with the masks that are kept for these cameras and views."""
    velocity = None if scene.velocities is None else scene.velocities[frame]
    depends_on = [scene.views, scene.cameras, scene.time_offsets, velocity, scene.ground]
    name = f"agreed_{content_hash(depends_on)[:12]}_{frame:04d}"
    found = kept.read(name)
    if found is not None:
        assert scene.load_with_mask is not None
        return {view: scene.load_with_mask(view, frame, mask) for view, mask in found.items()}
    pictures = correct(scene, frame)
    kept.write(name, {view: picture.mask for view, picture in pictures.items()})
    return pictures
