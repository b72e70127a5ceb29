"""The widgets of the page. They hold what was chosen; what to do with it is said by two functions: ``redraw`` and
``simulate``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from masiv.view.colours import legend
from masiv.view.nodes import Look
from masiv.view.shown import PLAIN, STRAIN, STRESS, UNITS, Shown
from masiv.view.subject import Subject
from masiv.view.variation import Variation, can_blend

LEAST = {"velocity": 3.0, "omega": 10.0, "gravity": 20.0}
"""Half of the range of a slider, at least: m/s, rad/s, m/s²."""
TITLES = {
    "velocity": ("Initial velocity [m/s]", "v"),
    "omega": ("Initial spin [rad/s]", "ω"),
    "gravity": ("Gravity [m/s²]", "g"),
}
STEP = 0.01
THIS, BETWEEN = "of this run", "in between"
LAYERS = {
    "gaussians": "Gaussians",
    "simulated": "Simulated",
    "observed": "Observed",
    "paths": "Simulated paths",
    "observed paths": "Observed paths",
    "cameras": "Cameras",
}
MAX_RATE = 60


class Controls:
    """The widgets in the ``gui`` of a viser server. Of what the subject does not have there is none."""

    def __init__(self, gui: Any, subject: Subject, redraw: Callable[[], None], simulate: Callable[[], None]) -> None:
        self.gui, self.subject, self.redraw, self.simulate = gui, subject, redraw, simulate
        self.status = gui.add_markdown("")
        self.progress = gui.add_progress_bar(0.0, visible=False)
        with gui.add_folder("Time"):
            self.frame = gui.add_slider("Frame", 0, subject.frames - 1, 1, 0)
            self.time = gui.add_markdown("")
            self.play = gui.add_checkbox("Play", False)
            self.rate = gui.add_slider("Frames a second", 1, MAX_RATE, 1, int(np.clip(subject.twin.fps / 2, 1, 24)))
        with gui.add_folder("Colours"):
            fields = self._fields()
            self.field = gui.add_dropdown("Particles by", (*fields, PLAIN), initial_value=(*fields, PLAIN)[0])
            self.top = gui.add_number("Range up to", 1.0, min=0.0, visible=False)
            self.legend = gui.add_html("", visible=False)
        with gui.add_folder("Show"):
            self.layers = {name: gui.add_checkbox(text, on) for name, text, on in self._layers()}
        self._effects()
        self._variation()
        if subject.notes:
            gui.add_markdown("\n\n".join(subject.notes))
        for widget in (self.frame, *self.layers.values()):
            widget.on_update(lambda _: self.redraw())
        self.field.on_update(lambda _: self._chosen_field())
        self.top.on_update(lambda _: self._chosen_top())
        self._shown: Shown | None = None

    @property
    def look(self) -> Look:
        """How the motion is to be drawn."""
        visible = frozenset(name for name, box in self.layers.items() if box.value)
        return Look(visible, self.field.value, self.top.value or 1.0)

    @property
    def variation(self) -> Variation:
        """What is to be simulated; components that were not moved are as identified, to the last digit."""
        given: dict[str, Any] = {}
        for name, sliders in self.vectors.items():
            exact = getattr(self.subject.twin, name)
            values = [s.value if s.value != first else float(x) for (s, first), x in zip(sliders, exact, strict=True)]
            moved = any(s.value != first for s, first in sliders)
            given[name] = tuple(values) if moved else None
        return Variation(**given, law=self._weight())

    def _weight(self) -> float:
        if self.law is None or self.law.value == THIS:
            return 0.0
        return float(self.weight.value) if self.law.value == BETWEEN and self.weight is not None else 1.0

    def show(self, shown: Shown) -> None:
        """Ranges of colours for a new motion."""
        self._shown = shown
        self._chosen_field()

    def say_time(self, frame: int) -> None:
        self.time.content = f"frame {frame}: {self.subject.times[frame]:.3f} s"

    def say(self, text: str) -> None:
        """One sentence, at the top of the page."""
        self.status.content = text
        self.progress.visible = False

    def say_progress(self, done: int, total: int) -> None:
        self.progress.value = 100.0 * done / max(total, 1)
        self.progress.visible = True

    def _chosen_field(self) -> None:
        name = self.field.value
        present = self._shown is not None and name in self._shown.fields
        self.top.visible = self.legend.visible = present
        if present:
            assert self._shown is not None
            self.top.value = float(f"{self._shown.top(name):.3g}")
        self._chosen_top()

    def _chosen_top(self) -> None:
        name = self.field.value
        if self._shown is not None and name in self._shown.fields:
            highest = float(self._shown.fields[name].max())
            self.legend.content = legend(name, UNITS[name], self.top.value or 1.0, highest)
        self.redraw()

    def _fields(self) -> tuple[str, ...]:
        return () if self.subject.twin.rigid else (STRESS, STRAIN)

    def _layers(self) -> list[tuple[str, str, bool]]:
        subject = self.subject
        there = {
            "gaussians": subject.gaussians is not None,
            "observed": subject.observed is not None,
            "observed paths": subject.observed is not None,
            "cameras": bool(subject.cameras),
        }
        on = {"simulated", "paths"} | ({"observed"} if subject.gaussians is None else set())
        return [(name, text, name in on) for name, text in LAYERS.items() if there.get(name, True)]

    def _effects(self) -> None:
        """What acts on the twin: names, values, and arrows."""
        effects = self.subject.twin.effects
        if not effects:
            return
        with self.gui.add_folder("Effects"):
            for effect in effects:
                rows = [
                    f"{name.replace('_', ' ')} {value:.4g}{'' if e is None else f' ± {e:.2g}'} "
                    + ("" if unit == "1" else unit)
                    for name, value, unit, e in effect.rows()[:8]
                ]
                if (layer := f"effect {effect.name}") not in self.layers:  # one of several bodies has each its own
                    self.layers[layer] = self.gui.add_checkbox(effect.name, True)
                whose = f"{', '.join(effect.bodies)}: " if effect.bodies else ""
                self.gui.add_markdown(whose + "; ".join(rows))
            self.arrows = self.gui.add_markdown("")

    def say_arrows(self, shown: Shown) -> None:
        """How long arrows are."""
        if self.subject.twin.effects:
            lines = [f"longest arrow of {n}: {shown.strongest(n):.3g} m/s²" for n in shown.accelerations]
            others = [e.name for e in self.subject.twin.effects if e.name not in shown.accelerations]
            lines += [f"{name} gives no acceleration" for name in others]
            self.arrows.content = "\n\n".join(lines)

    def _variation(self) -> None:
        subject = self.subject
        names = ["gravity"]
        if not subject.released:
            names = ["velocity", "gravity"] if subject.twin.rigid else ["velocity", "omega", "gravity"]
        self.vectors: dict[str, list[tuple[Any, float]]] = {}
        for name in names:
            title, symbol = TITLES[name]
            values = np.asarray(getattr(subject.twin, name), dtype=float)
            half = float(np.ceil(max(LEAST[name], 2 * np.abs(values).max())))
            with self.gui.add_folder(title):
                sliders = [
                    self.gui.add_slider(f"{symbol} {axis}", -half, half, STEP, round(float(value), 2))
                    for axis, value in zip("xyz", values, strict=True)
                ]
            self.vectors[name] = [(slider, slider.value) for slider in sliders]
        self.law = self.weight = None
        if subject.other is not None:
            self._law(subject.other)
        reset = self.gui.add_button("As identified")
        reset.on_click(lambda _: self._reset())
        for slider, _ in (pair for pairs in self.vectors.values() for pair in pairs):
            slider.on_update(lambda _: self.simulate())

    def _law(self, other: Any) -> None:
        between = can_blend(self.subject.twin, other)
        options = (THIS, f"of {self.subject.other_name}", *((BETWEEN,) if between else ()))
        with self.gui.add_folder("Law"):
            self.law = self.gui.add_dropdown("Law", options, initial_value=THIS)
            if between:
                self.weight = self.gui.add_slider("Share of the other law", 0.0, 1.0, STEP, 0.5, visible=False)
                self.weight.on_update(lambda _: self.simulate())
        self.law.on_update(lambda _: self._chosen_law())

    def _chosen_law(self) -> None:
        assert self.law is not None
        if self.weight is not None:
            self.weight.visible = self.law.value == BETWEEN
        self.simulate()

    def _reset(self) -> None:
        for slider, first in (pair for pairs in self.vectors.values() for pair in pairs):
            slider.value = first
        if self.law is not None:
            self.law.value = THIS
        self.simulate()
