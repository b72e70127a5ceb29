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


def searched_causes() -> dict[str, Effect]:
    """The causes that a search considers if the configuration names none."""
    return {name: effect for name, effect in causes().items() if not effect.hints.on_request}


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


def cause_of(name: str) -> str:
    """The cause that the effect of that name is a shape of: itself, unless it says otherwise. Raises InputError."""
    return effect_named(name).hints.shape_of or name


def effect_named(name: str) -> Effect:
    """The effect of that name. Raises InputError if the library has none."""
    known = effects()
    if name not in known:
        raise InputError(f"unknown effect '{name}': use one of {', '.join(known)}")
    return known[name]
