"""Colours of particles by a field, and the legend that says what they mean."""

from __future__ import annotations

import html

import numpy as np

MAP = "viridis"
TOP_PERCENTILE = 99.5
"""Of the values of a motion, where the range of colours ends: a few particles at an impact would darken all others."""


def field_range(values: np.ndarray) -> float:
    """The upper end of the range for ``values`` (T, Q), which begins at 0."""
    top = float(np.percentile(values, TOP_PERCENTILE))
    return top if top > 0 else 1.0


def coloured(values: np.ndarray, top: float) -> np.ndarray:
    """values (Q,) -> colours (Q, 3) uint8; 0 to ``top`` over the map, values above it like the top."""
    from matplotlib import colormaps

    return colormaps[MAP](np.clip(np.nan_to_num(values / top), 0, 1), bytes=True)[:, :3]


def legend(name: str, unit: str, top: float, highest: float) -> str:
    """HTML of the range: name, unit, colours, 0 to ``top``; ``highest`` is the largest value of the motion."""
    from matplotlib import colormaps

    stops = ", ".join("rgb({},{},{})".format(*colormaps[MAP](k / 10, bytes=True)[:3]) for k in range(11))
    marks = "".join(f"<span>{_digits(k * top / 4)}</span>" for k in range(5))
    return (
        '<div style="padding:0 0.75em 0.5em;font-size:0.8em">'
        f"<div>{html.escape(name)} [{html.escape(unit)}]; highest {_digits(highest)}</div>"
        f'<div style="height:0.9em;background:linear-gradient(to right, {stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{marks}</div></div>'
    )


def _digits(value: float) -> str:
    """``value`` with three digits, without an exponent unless it is very small or large."""
    return f"{float(f'{value:.3g}'):,.10g}"
