"""The twin as identify made it, kept in addition to the one to which refine added effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from masiv.twin.document import TWIN_FILE
from masiv.twin.twin import Twin

IDENTIFIED_FILE = "twin.before.yaml"
DescribedTwin = Callable[[], Twin]
"""The twin that a scene of tracks describes, see ``Twin.load``."""


def load_identified(folder: Path, scene: DescribedTwin | None = None) -> Twin:
    """The twin without effects that refine added. Raises InputError."""
    name = IDENTIFIED_FILE if (folder / IDENTIFIED_FILE).is_file() else TWIN_FILE
    return Twin.load(folder, name, scene=scene)


def load_to_refine(folder: Path, condition: str | None = None, scene: DescribedTwin | None = None) -> Twin:
    """The twin from which refine of ``condition`` (None: the first) starts: without what an earlier one added there.

    The first condition starts with what identify found; effects of other conditions stay. Raises InputError.
    """
    current = Twin.load(folder, scene=scene)
    first = current.conditions[0]
    if condition not in (None, first):
        return current.without_condition(condition)
    identified = load_identified(folder, scene)
    others = tuple(effect for effect in current.effects if effect.condition is not None)
    by_name = {(start.observation, start.body): start for start in current.initial_conditions}
    starts = tuple(
        start if start.condition == first else by_name.get((start.observation, start.body), start)
        for start in identified.initial_conditions
    )
    return replace(identified, effects=others, initial_conditions=starts)


def save_refined(folder: Path, twin: Twin, scene: DescribedTwin | None = None) -> None:
    """Save ``twin``, after the one that identify made is kept under another name."""
    if not (folder / IDENTIFIED_FILE).is_file():
        Twin.load(folder, scene=scene).save(folder, IDENTIFIED_FILE)
    twin.save(folder)


def restore_identified(folder: Path, scene: DescribedTwin | None = None) -> None:
    """Undo ``save_refined``, if there was one. Raises InputError."""
    if (folder / IDENTIFIED_FILE).is_file():
        load_identified(folder, scene).save(folder)
        (folder / IDENTIFIED_FILE).unlink()
