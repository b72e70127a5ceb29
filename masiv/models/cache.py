"""Rollouts that are kept: in memory, and in a folder, so that a search that was killed goes on."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.files import read_npz, write_npz
from masiv.observations.identity import content_hash, source_digest

COMPUTING = ("kernels", "mpm", "materials", "effects", "models")
"""Packages whose code a rollout depends on."""
FORMAT = 1
"""Of the files."""

Arrays = dict[str, np.ndarray]


@functools.lru_cache(maxsize=1)
def code_digest() -> str:
    """Of the code that computes a rollout."""
    return content_hash((FORMAT, source_digest(*COMPUTING)))


class RolloutCache:
    """Arrays by a key that holds everything they depend on: body, law, effects, start, instants, substep, contact.

    capacity: entries kept in memory, the oldest goes first. folder: where files are kept; None: nowhere. Their names
    also depend on the code, so that a rollout of another version is not taken for one of this.
    """

    def __init__(self, capacity: int, folder: Path | None = None) -> None:
        self.capacity = capacity
        self.folder = folder
        self._kept: dict[str, Arrays] = {}

    def get(self, key: Any, compute: Callable[[], Arrays]) -> Arrays:
        """The arrays of ``key`` (plain values, see ``content_hash``), from ``compute`` if they are not kept."""
        name = content_hash(key)
        if name in self._kept:
            return self._kept[name]
        file = None if self.folder is None else self.folder / f"{content_hash((name, code_digest()))[:24]}.npz"
        found = None if file is None or not file.is_file() else _read(file)
        if found is None:
            found = compute()
            if file is not None:
                write_npz(file, compressed=False, **found)
        while len(self._kept) >= self.capacity:
            self._kept.pop(next(iter(self._kept)))
        self._kept[name] = found
        return found


def _read(file: Path) -> Arrays | None:
    try:
        return read_npz(file)
    except InputError:
        warnings.warn(f"{file}, a rollout that was kept, is damaged: it is simulated again", stacklevel=3)
        return None
