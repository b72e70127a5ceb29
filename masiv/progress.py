"""How a stage reports that it is alive, without knowing about terminals."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """``done`` of ``total`` iterations of ``stage`` are finished; ``note`` is a short status (a loss with its
        unit)."""
        ...


def silent(stage: str, done: int, total: int, note: str = "") -> None:
    """The progress of a caller that does not care."""
