"""Resumable stages: a state that is saved from time to time, atomically, and loaded after an interruption."""

from __future__ import annotations

import io
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from masiv.files import require_file, write_bytes

FORMAT = 2
"""Of the states: it changes when a stage keeps other things."""


class Checkpoint:
    """The state of one stage on disk: tensors and plain values. ``Checkpoint(None)`` saves nothing.

    The random numbers of a stage must be a function of (seed, iteration), so that a resumed stage has the same result.
    """

    def __init__(self, path: Path | None, every_s: float = 20.0) -> None:
        self.path = path
        self.every_s = every_s
        self._last = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """The last state that was saved, or None. A file that is damaged, or of another stage or version of masiv, is
        removed with a warning: the stage begins anew."""
        if self.path is None or not self.path.exists():
            return None
        import torch

        try:
            file = torch.load(require_file(self.path), weights_only=True)
            state, of = file["state"], file["of"]
            if of == self._mark and isinstance(state, dict):
                return state
            reason = "is of another stage or version of masiv"
        except Exception:  # zip, pickle and torch raise what they like for damaged data
            reason = "is damaged"
        warnings.warn(f"{self.path} {reason}: it is removed, and the stage begins anew", stacklevel=2)
        self.path.unlink(missing_ok=True)
        return None

    @property
    def _mark(self) -> list[str | int]:
        """What a file must be of for its state to be understood."""
        return ["" if self.path is None else self.path.stem, FORMAT]

    def maybe_save(self, make_state: Callable[[], dict[str, Any]]) -> None:
        """Save ``make_state()`` if the last save is more than ``every_s`` seconds ago."""
        if self.path is not None and time.monotonic() - self._last >= self.every_s:
            self.save(make_state())

    def save(self, state: dict[str, Any]) -> None:
        """Save now, completely or not at all."""
        if self.path is None:
            return
        import torch

        data = io.BytesIO()  # torch's own writer ends the process where a disk is full
        torch.save({"of": self._mark, "state": state}, data)
        write_bytes(self.path, data.getvalue())
        self._last = time.monotonic()

    def part(self, name: str) -> Checkpoint:
        """The checkpoint of a part that runs beside the stage, in a file of its own; ``clear`` removes it, too."""
        return Checkpoint(self.path and self.path.with_stem(f"{self.path.stem}-{name}"), self.every_s)

    def clear(self) -> None:
        """Remove the state, after the stage is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            for part in self.path.parent.glob(f"{self.path.stem}-*{self.path.suffix}"):
                part.unlink()


class NestedCheckpoint(Checkpoint):
    """``parent`` for a part of its stage: every state that is saved also holds ``fixed``, the results of earlier parts.

    ``load`` gives the whole state. A key of a saved state takes the place of the same key in ``fixed``.
    """

    def __init__(self, parent: Checkpoint, fixed: dict[str, Any]) -> None:
        super().__init__(parent.path, parent.every_s)
        self._parent = parent
        self._fixed = fixed

    def save(self, state: dict[str, Any]) -> None:
        self._parent.save({**self._fixed, **state})
        self._last = time.monotonic()
