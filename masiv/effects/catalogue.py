"""The effects of this folder, by name."""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil

import masiv.effects
from masiv.effects.effect import Effect
from masiv.errors import InputError


def causes() -> dict[str, Effect]:
    """The effects that a search may name: all but discrepancy forces."""
    return {name: effect for name, effect in effects().items() if effect.hints.cause}


@functools.lru_cache(maxsize=1)
def effects() -> dict[str, Effect]:
    """Every effect by its name, in alphabetical order: the concrete subclasses of ``Effect`` in the modules here.

    To add one is to add its file.
    """
    found: dict[str, Effect] = {}
    for module in pkgutil.iter_modules(masiv.effects.__path__):
        if module.ispkg:
            continue
        loaded = importlib.import_module(f"masiv.effects.{module.name}")
        for value in vars(loaded).values():
            if not isinstance(value, type) or not issubclass(value, Effect) or value.__module__ != loaded.__name__:
                continue
            if not inspect.isabstract(value) and hasattr(value, "name"):
                found[value.name] = value()
    return dict(sorted(found.items()))


def effect_named(name: str) -> Effect:
    """The effect of that name. Raises InputError if the library has none."""
    known = effects()
    if name not in known:
        raise InputError(f"unknown effect '{name}': use one of {', '.join(known)}")
    return known[name]
