"""A law in the terms of a material tester, over the strains that an observed motion excited."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.characterization import curves
from masiv.characterization.excitation import Excited, Sensitivity, excited_range, sensitivities
from masiv.characterization.families import Match, nearest_families
from masiv.files import write_json
from masiv.materials.law import Law
from masiv.progress import Progress, silent
from masiv.subsample import kd_tree_subset

if TYPE_CHECKING:
    from masiv.twin import Twin

LOADING_STEPS = 80
"""Increments of a loading."""
YIELD_OFFSET = 2e-3
"""Permanent strain [1] at which a material is said to yield."""
MIN_RATE_EXPONENT = 0.05
"""Exponent [1] of the flow stress over the rate from which flow counts as viscous."""
MIN_TEST_STRAIN, MAX_TEST_STRAIN = 0.02, 0.5
"""Bounds [1] of the strain at which a law is tested."""
DRAWN_RANGE = 1.5
"""Range of the curves, over that of the observed strains."""
SOLID, GRANULAR, FLUID = "solid", "granular", "fluid"


@dataclass(frozen=True)
class Quantity:
    """A value in ``unit`` and its standard error in percent, if known. value None: there is none, ``note`` says why."""

    value: float | None
    unit: str
    note: str = ""
    stderr_percent: float | None = None


@dataclass(frozen=True)
class Material:
    """A law in a tester's terms: behaviour in words, quantities by name, families nearest first, and curves.

    error_mm: of the fit [mm]. curves: name -> strain, stress_pa, family_pa (nearest family), observed (low, high).
    """

    behaviour: str
    quantities: dict[str, Quantity]
    families: list[Match]
    excited: Excited
    sensitivities: list[Sensitivity] = field(default_factory=list)
    error_mm: float | None = None
    curves: dict[str, dict[str, Any]] = field(default_factory=dict)

    def as_data(self) -> dict[str, Any]:
        """What material.json holds."""
        return {"schema": 1, "summary": paragraph(self), **asdict(self)}

    def save(self, path: Path) -> None:
        """Write ``path`` (.json), complete or not at all."""

        write_json(path, self.as_data())


def describe(law: Law, excited: Excited, *, substep: float = 5e-4) -> Material:
    """``law`` over the range ``excited``, with increments of about ``substep`` [s].

    Moduli are those of the stress at F = I. The yield stress is that at 0.2 % permanent axial strain with free sides.
    The permanent strain is known, so the usual assumption that unloading follows the initial slope is not needed.
    """
    law = curves.in_float64(law)
    strain = float(np.clip(excited.strain[1], MIN_TEST_STRAIN, MAX_TEST_STRAIN))
    log_volume = min(excited.log_volume[0], -2e-3), max(excited.log_volume[1], 2e-3)
    rate = max(excited.rate, strain / (LOADING_STEPS * 2 * substep))  # slower loading would flow in too long steps
    kind = _strength_kind(law, excited, log_volume[0], rate)
    shear, bulk = curves.moduli_at_rest(law)
    quantities = _elastic(kind, shear, bulk)
    dt = strain / (rate * LOADING_STEPS)
    flow, exponent = _flow(law, strain, dt)
    yielding, yields = _yield(law, kind, strain, dt)
    quantities["yield stress"] = yielding
    if kind == GRANULAR:
        quantities["friction angle"] = _friction(law, log_volume[0], strain, dt)
    flows = kind == FLUID or yields
    if flows and flow > 0 and exponent > MIN_RATE_EXPONENT:
        gamma_rate = math.sqrt(3) * rate
        note = f"apparent, at a shear rate of {gamma_rate:.2g}/s; flow stress ~ rate^{exponent:.2f}"
        quantities["viscosity"] = Quantity(flow / gamma_rate, "Pa s", note)
        level = float(np.clip(math.sqrt(3) * excited.elastic_strain[1], 1e-3, 0.5))
        time = curves.relaxation_time(law, level)
        note = f"of a shear of {100 * level:.2g} % that is held" + ("" if time else ": none within 10 s")
        quantities["relaxation time"] = Quantity(time, "s", note)
    families = nearest_families(law, strain=strain, log_volume=log_volume, rate=rate)
    behaviour = _behaviour(kind, yields, flows and exponent > MIN_RATE_EXPONENT)
    made = Material(behaviour, quantities, families, excited)
    return replace(made, curves=_curves(law, families[0], excited, strain, log_volume, dt))


def describe_twin(
    twin: Twin, *, frames: int, trajectory: np.ndarray | None = None, particles: int = 1500, progress: Progress = silent
) -> Material:
    """``describe`` for the law of ``twin``, with how well ``frames`` frames of its motion determine it.

    trajectory (T, Q, 3) [m]: what it was fitted to, if known; the residual gives the number of independent data.
    Rollouts take at most ``particles`` of the twin's particles.
    """
    from masiv import runtime
    from masiv.simulation.free_body import iterate_states
    from masiv.simulation.simulate import simulate

    chosen = kd_tree_subset(twin.positions.astype(np.float64), particles)
    coarse = replace(
        twin.with_body(particles=twin.positions[chosen]),
        simulator=twin.simulator.model_copy(update={"subparticles": 1}),
    )
    done = 0

    def reroll(law: Law) -> np.ndarray:
        nonlocal done
        done += 1
        progress("describe", done, 6)
        return simulate(coarse.with_body(law=law), frames=frames, fps=twin.fps).positions

    with runtime.torch_threads(1):
        excited = excited_range(iterate_states(coarse, frames=frames, fps=twin.fps))
        progress("describe", 0, 6)
        material = describe(twin.law, excited)
        residual = None
        if trajectory is not None:
            residual = reroll(twin.law)[1:].astype(np.float64) - trajectory[1:frames, chosen]
        error = twin.fit.get("trajectory_error_mm")
        if error is None and residual is not None:
            error = float(1e3 * np.sqrt((residual**2).sum(2).mean()))
        if error is None:
            return material
        return with_sensitivities(material, sensitivities(reroll, twin.law, error_mm=error, residual=residual), error)


def with_sensitivities(material: Material, found: list[Sensitivity], error_mm: float) -> Material:
    """``material`` with how well the motion determines it: the sensitivities, and standard errors of its quantities."""
    of = {"shear modulus": ("shear modulus", "Young's modulus"), "bulk modulus": ("bulk modulus",),
          "flow strain": ("yield stress",), "yield stress": ("yield stress",), "friction angle": ("friction angle",),
          "relaxation time": ("relaxation time", "viscosity"), "viscosity": ("viscosity",)}  # fmt: skip
    quantities = dict(material.quantities)
    for item in found:
        for name in of.get(item.name, ()):
            if name in quantities and quantities[name].value is not None:
                note = quantities[name].note
                if item.moved_mm is not None and not item.excited:
                    note = "; ".join(part for part in (note, "not excited by this motion") if part)
                quantities[name] = replace(quantities[name], stderr_percent=item.stderr_percent, note=note)
    return replace(material, quantities=quantities, sensitivities=found, error_mm=error_mm)


def paragraph(material: Material | dict[str, Any]) -> str:
    """The answer in a few sentences, of a ``Material`` or of the content of material.json."""
    if isinstance(material, dict):
        return str(material["summary"])
    best = material.families[0]
    numbers = [f"{name} {formatted(q)}" for name, q in material.quantities.items()]
    values = ", ".join(
        f"{n.replace('_', ' ')} {formatted(Quantity(v['value'], v['unit'].strip('1')))}"
        for n, v in best.parameters.items()
    )
    others = ", ".join(f"{m.kind} {m.misfit_percent:.0f} %" for m in material.families[1:])
    seen = material.excited
    text = [
        f"Material: {material.behaviour}. {'; '.join(numbers)}.",
        f"Nearest classical law: {best.kind} ({values}), residual {best.misfit_percent:.1f} %; others: {others}.",
        f"Observed: strains up to {100 * seen.strain[1]:.0f} %, elastic up to {100 * seen.elastic_strain[1]:.1f} %, "
        f"volume {100 * math.expm1(seen.log_volume[0]):+.1f} to {100 * math.expm1(seen.log_volume[1]):+.1f} %, "
        f"strain rates up to {seen.rate:.2g}/s.",
    ]
    unexcited = [s.name for s in material.sensitivities if s.moved_mm is not None and not s.excited]
    if unexcited:
        text.append(
            f"Not excited by this motion: {', '.join(unexcited)} (10 % more moves the body by less than a tenth of the "
            f"fit's error of {material.error_mm:.1f} mm)."
        )
    return " ".join(text)


def formatted(quantity: Quantity) -> str:
    """'41 kPa ± 3 %', with the note if there is one."""
    if quantity.value is None:
        return quantity.note or "none"
    value, unit = quantity.value, quantity.unit
    if unit == "Pa" and abs(value) >= 1e3:
        value, unit = (value / 1e6, "MPa") if abs(value) >= 1e6 else (value / 1e3, "kPa")
    text = f"{value:.3g} {unit}".strip()
    if quantity.stderr_percent is not None:
        text += f" ± {quantity.stderr_percent:.0f} %" if quantity.stderr_percent <= 100 else " ± more than 100 %"
    return text + (f" ({quantity.note})" if quantity.note else "")


def _strength_kind(law: Law, excited: Excited, lowest: float, rate: float) -> str:
    """SOLID if a small shear stays elastic while it is loaded, GRANULAR if it does under pressure only, else FLUID."""
    shear = float(np.clip(0.25 * excited.elastic_strain[1], 2e-4, 5e-3))
    hold = shear / rate
    if curves.kept_shear(law, shear, 0.0, hold) > 0.5:
        return SOLID
    return GRANULAR if curves.kept_shear(law, 0.1 * abs(lowest), lowest, hold) > 0.5 else FLUID


def _elastic(kind: str, shear: float, bulk: float) -> dict[str, Quantity]:
    if kind == FLUID:
        none = Quantity(None, "Pa", "none, shear flows away at once")
        return {"shear modulus": none, "bulk modulus": Quantity(bulk, "Pa")}
    note = "under pressure" if kind == GRANULAR else ""
    return {
        "Young's modulus": Quantity(9 * bulk * shear / (3 * bulk + shear), "Pa", note),
        "Poisson's ratio": Quantity((3 * bulk - 2 * shear) / (2 * (3 * bulk + shear)), ""),
        "shear modulus": Quantity(shear, "Pa", note),
        "bulk modulus": Quantity(bulk, "Pa"),
    }


def _flow(law: Law, strain: float, dt: float) -> tuple[float, float]:
    """Shear stress [Pa] at the end of the loading, and the exponent with which it grows with the rate."""
    amounts = math.sqrt(3) * strain * np.arange(1, LOADING_STEPS + 1) / LOADING_STEPS
    path = curves.simple_shear(amounts)[:, None]
    stress = [float(curves.drive(law, path, dt / quicker)[1][-1, 0, 0, 1]) for quicker in (1, 10)]
    if stress[0] <= 0 or stress[1] <= 0:
        return max(stress[0], 0.0), 0.0
    return stress[0], math.log10(stress[1] / stress[0])


def _yield(law: Law, kind: str, strain: float, dt: float) -> tuple[Quantity, bool]:
    if kind != SOLID:
        return Quantity(0.0, "Pa", "no strength without pressure" if kind == GRANULAR else "a fluid has none"), True
    curve = curves.uniaxial(law, -strain * np.arange(1, LOADING_STEPS + 1) / LOADING_STEPS, dt)
    permanent = np.abs(np.concatenate([[0.0], curve.permanent]))
    stress = np.abs(np.concatenate([[0.0], curve.stress]))
    after = np.flatnonzero(permanent >= YIELD_OFFSET)
    if len(after) == 0:
        return Quantity(None, "Pa", f"none up to the strain observed ({100 * strain:.0f} %)"), False
    k = after[0]
    share = (YIELD_OFFSET - permanent[k - 1]) / (permanent[k] - permanent[k - 1])
    value = stress[k - 1] + share * (stress[k] - stress[k - 1])
    return Quantity(float(value), "Pa", "uniaxial, 0.2 % permanent strain"), True


def _friction(law: Law, log_volume: float, strain: float, dt: float) -> Quantity:
    """Friction angle from |tau_dev| = 3 alpha p in shear under pressure; alpha: ``kernels.laws.drucker_prager``."""
    amounts = math.sqrt(3) * strain * np.arange(1, LOADING_STEPS + 1) / LOADING_STEPS
    stress = curves.drive(law, curves.simple_shear(amounts, log_volume)[:, None], dt)[1][-1, 0]
    pressure = -float(stress.trace()) / 3
    deviator = float(np.linalg.norm(stress.numpy() + pressure * np.eye(3)))
    if pressure <= 0:
        return Quantity(None, "deg", "no pressure builds up")
    alpha = deviator / (3 * pressure)
    sine = 3 * alpha / (2 * math.sqrt(2 / 3) + alpha)
    return Quantity(math.degrees(math.asin(min(sine, 1.0))), "deg")


def _behaviour(kind: str, yields: bool, viscous: bool) -> str:
    if kind == FLUID:
        return "a viscous fluid" if viscous else "a fluid without shear strength"
    if kind == GRANULAR:
        return "granular, strong under pressure only"
    if not yields:
        return "an elastic solid"
    return "an elastic solid that yields" + (", the faster the stiffer" if viscous else "")


def _curves(
    law: Law, nearest: Match, excited: Excited, strain: float, log_volume: tuple[float, float], dt: float
) -> dict[str, dict[str, Any]]:
    """Loading curves of the law and of the nearest family, ``DRAWN_RANGE`` times the observed range."""
    from masiv.materials.classical import ClassicalLaw

    family = None
    if nearest.parameters:
        family = curves.in_float64(ClassicalLaw(nearest.kind, **{n: v["value"] for n, v in nearest.parameters.items()}))
    reach = DRAWN_RANGE * strain
    steps = np.arange(1, LOADING_STEPS + 1) / LOADING_STEPS
    shear = curves.there_and_back(math.sqrt(3) * reach, LOADING_STEPS)
    volumes = [curves.dilation(DRAWN_RANGE * v * steps) for v in log_volume]
    out: dict[str, dict[str, Any]] = {}

    def add(
        name: str, x: np.ndarray, path: Any, entry: tuple[int, int] | None, step: float, seen: tuple[float, float]
    ) -> None:
        stresses = [
            None if one is None else _component(curves.drive(one, path[:, None], step)[1][:, 0], entry)
            for one in (law, family)
        ]
        out[name] = {"strain": x, "stress_pa": stresses[0], "family_pa": stresses[1], "observed": seen}

    seen = (0.0, math.sqrt(3) * excited.strain[1])
    add("simple shear, there and back", shear, curves.simple_shear(shear), (0, 1), DRAWN_RANGE * dt, seen)
    stretched = curves.there_and_back(-reach, LOADING_STEPS)
    add("compression at constant volume, there and back", stretched, curves.stretch(stretched), None, DRAWN_RANGE * dt,
        (-excited.strain[1], 0.0))  # fmt: skip
    add("compression of the volume", DRAWN_RANGE * log_volume[0] * steps, volumes[0], (0, 0), dt, excited.log_volume)
    add("dilation of the volume", DRAWN_RANGE * log_volume[1] * steps, volumes[1], (0, 0), dt, excited.log_volume)
    return out


def _component(stress: Any, entry: tuple[int, int] | None) -> np.ndarray:
    """An entry (T,) of stresses (T, 3, 3), or the axial one less the sides', which pressure does not change."""
    return (stress[:, 0, 0] - stress[:, 1, 1] if entry is None else stress[:, entry[0], entry[1]]).numpy()
