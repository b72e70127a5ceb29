"""The effects of this folder, by name."""

from __future__ import annotations

import functools
import importlib
import pkgutil

import masiv.effects
from masiv.effects.effect import Effect
from masiv.errors import InputError

_NOT_EFFECTS = {"effect", "catalogue", "active"}


def causes() -> dict[str, Effect]:
    """The effects that a search may name: all but stop-gaps."""
    return {name: effect for name, effect in effects().items() if effect.cause}


@functools.lru_cache(maxsize=1)
def effects() -> dict[str, Effect]:
    """Every effect by its name, in alphabetical order. Adding one is adding its file."""
    found = {}
    for module in pkgutil.iter_modules(masiv.effects.__path__):
        if module.name in _NOT_EFFECTS or module.name.startswith("_"):
            continue
        loaded = importlib.import_module(f"masiv.effects.{module.name}")
        for value in vars(loaded).values():
            if isinstance(value, type) and issubclass(value, Effect) and value.__module__ == loaded.__name__:
                found[value.name] = value()
    return dict(sorted(found.items()))


def effect_named(name: str) -> Effect:
    """Raises InputError for a name that is not in the library."""
    known = effects()
    if name not in known:
        raise InputError(f"unknown effect '{name}': use one of {', '.join(known)}")
    return known[name]
