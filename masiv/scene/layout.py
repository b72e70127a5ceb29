"""What a reader of one layout of files provides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

Read = TypeVar("Read", covariant=True)


@dataclass(frozen=True)
class Layout(Generic[Read]):
    """A layout of files that ``masiv.observations.read`` knows.

    name: for messages. files: those by which ``can_read(path)`` recognizes the layout. ``read(path)`` raises InputError
    if they cannot be used, and reads the ``scene.yaml`` next to them.
    """

    name: str
    files: str
    can_read: Callable[[Path], bool]
    read: Callable[[Path], Read]
