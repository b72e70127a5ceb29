"""A clamped bar with markers: law and damping from how it swings, a load from how it swings otherwise; and commands."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from dropped_balls import Ball, write_scene
from small import SMALL

from masiv.cli import main
from masiv.effects.catalogue import effect_named
from masiv.errors import InputError
from masiv.identification.from_tracks import described_twin
from masiv.identification.tracks import clamped_body_model, fit_law
from masiv.inference.model_fit import gauss_newton_fit
from masiv.materials.classical import ClassicalLaw
from masiv.models.base import Model
from masiv.models.clamped_body import ClampedBodyModel
from masiv.models.deformable import halved
from masiv.models.families import family_of
from masiv.models.marked_body import marked_body
from masiv.models.release import clamp_axes, static_deflection
from masiv.refinement.candidates import score
from masiv.refinement.config import RefineConfig
from masiv.refinement.document import document
from masiv.refinement.effect_fit import fit_with_effect
from masiv.refinement.from_tracks import refine_tracks
from masiv.refinement.residual_arrays import arrays
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine
from masiv.refinement.to_twin import refined_twin
from masiv.simulation.fitted_twin import fitted_twin, law_values, place_of
from masiv.tracks.config import TracksConfig
from masiv.tracks.read import read_tracks

pytestmark = pytest.mark.usefixtures("taichi")
YOUNGS, RATIO, VISCOSITY, LOAD = 2e5, 0.2, 150.0, 0.04
PARTICLES, DURATION, RATE = 64, 0.22, 100.0
SIMULATOR = SMALL.model_copy(update={"courant_number": 0.6, "max_substeps_per_frame": 4000})
TRACKS = TracksConfig(particles=PARTICLES, duration=DURATION, rollouts=12)
NOISE = 2e-5


def write_bar(folder: Path, runs) -> Path:
    """Runs (name, condition, use) of a bar along z, held at its lower end, gravity along -x: with its own damping, and
    in condition ``load`` with a mass near its tip. The rest of 10 frames comes first."""
    at = {"a": [0, 0, 50], "b": [15, 0, 40], "c": [0, 15, 20], "base": [0, 0, -50]}
    declared = {
        "layout": "tracks", "up_axis": "x", "units": "m",
        "bodies": {"bar": {
            "density": 1070, "poissons_ratio": RATIO,
            "geometry": {"box": [30, 30, 100], "units": "mm", "position": [0, 0, 0.05]},
            "clamp": {"half_space": {"normal": [0, 0, 1], "height": -50}, "markers": ["base"]},
        }},
        "runs": [{"file": f"{name}.csv", "name": name, "condition": condition, "use": use, "rest_frames": [0, 10],
                  "release_time": 0.1} for name, condition, use in runs],
    }  # fmt: skip
    (folder / "scene.yaml").write_text(yaml.safe_dump(declared))
    places = np.array(list(at.values())) / 1e3 + [0, 0, 0.05]
    times = np.arange(0, DURATION + 0.02, 1 / RATE)
    still = np.tile(places, (10, 1, 1))
    for seed, (name, _, _) in enumerate(runs):
        whole = np.concatenate([still, np.tile(places, (len(times), 1, 1))])
        save(folder / f"{name}.csv", at, whole, seed)
    tracks = read_tracks(folder)
    for seed, (name, condition, _) in enumerate(runs):
        run = next(r for r in tracks.runs if r.name == name)
        body = marked_body(tracks, run, SIMULATOR, particle_spacing=(9e-5 / PARTICLES) ** (1 / 3))
        members = [(effect_named("viscosity"), torch.tensor([VISCOSITY]))]
        if condition == "load":
            tip = body.particles[:, 2].max().item()
            members.append((effect_named("point_mass"), torch.tensor([LOAD, 0.0, 0.0, tip])))
        law = ClassicalLaw("neo_hookean", youngs_modulus=YOUNGS, poissons_ratio=RATIO)
        acting = body.effects(members, body.context(float(times[-1]), float(times[-1]) / (len(times) - 1)))
        # What so coarse a grid dissipates goes with the inverse of the substep: it is chosen as a fit would.
        substep = halved(body.substep(law, times), body.substep(law, times, acting), 0.0)
        moved = body.markers_to_world(body.run(law, times, acting, substep=substep)[1])
        free = np.tile(places, (len(times), 1, 1))
        free[:, :3] = moved
        save(folder / f"{name}.csv", at, np.concatenate([still, free]), seed)
    return folder


def save(path: Path, names, points: np.ndarray, seed: int) -> None:
    points = points + np.random.default_rng(seed).normal(0, NOISE, points.shape)
    header = "time_s," + ",".join(f"{m}_{axis}_m" for m in names for axis in "xyz")
    rows = [f"{k / RATE:.4f}," + ",".join(f"{v:.8f}" for v in p.ravel()) for k, p in enumerate(points)]
    path.write_text("\n".join([header, *rows]))


def only(simulation, names):
    """``simulation`` with these causes alone: a test has not the time for all."""
    every = simulation.candidates
    simulation.candidates = lambda model: [n for n in every(model) if n in names]
    return simulation


def quiet(*_):
    """No progress."""


def settings(**changes):
    """Of a search for one effect; a smooth force for the rest would take long."""
    config = RefineConfig.model_validate({"max_effects": 1, **changes})
    return SearchSettings.of(config, discrepancy_force=False)


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    runs = [("own_a", "", "fit"), ("own_b", "", "hold_out"), ("load_a", "load", "fit"), ("load_b", "load", "hold_out")]
    return read_tracks(write_bar(tmp_path_factory.mktemp("bar"), runs))


@pytest.mark.slow
def test_damping_is_found_and_the_law_with_it(bar):
    known = {"poissons_ratio": RATIO}
    simulation = only(
        clamped_body_model(bar, "", TRACKS, SIMULATOR, known=known), ("viscosity", "gravity_scale", "linear_drag")
    )
    base = fit_law(simulation, family_of("neo_hookean", 1070, known), TRACKS, quiet)
    assert base.values["youngs_modulus"] == pytest.approx(YOUNGS, rel=0.15)
    result = refine(simulation, [base], settings(shortlist=3))
    after = result.after
    assert after.model.effects == ("viscosity",)
    assert after.values["youngs_modulus"] == pytest.approx(YOUNGS, rel=0.02)
    # The grid's own dissipation is of that size, and the substep that the law was first fitted with is a longer one.
    assert after.values["viscosity.viscosity"] == pytest.approx(VISCOSITY, rel=0.15)
    assert after.validation_mm < 0.1
    assert after.validation_mm < 0.25 * result.before.validation_mm
    drag = [t for t in result.search.rounds[0].trials if t.effect == "linear_drag"]
    assert [any("it takes a medium of" in why for why in t.impossible) for t in drag] == [True]


@pytest.mark.slow
def test_load_is_a_mass_at_the_tip_and_no_force(bar):
    known = {"poissons_ratio": RATIO, "youngs_modulus": YOUNGS, "viscosity.viscosity": VISCOSITY}
    simulation = only(clamped_body_model(bar, "load", TRACKS, SIMULATOR, known=known), ("point_mass", "gravity_scale"))
    family = family_of("neo_hookean", 1070, known)
    base = gauss_newton_fit(simulation, Model(family, "none", ("viscosity",)), {}, budget=4)
    assert simulation.curriculum(base.fields)  # its phase is lost
    result = refine(simulation, [base], settings(shortlist=1))
    after = result.after
    assert after.model.effects == ("viscosity", "point_mass")
    assert after.values["point_mass.mass"] == pytest.approx(LOAD, rel=0.05)
    assert after.validation_mm < 0.2 < 0.1 * result.before.validation_mm
    share = {c.effect: c.explained for c in result.search.rounds[0].candidates}
    assert 1 - share["point_mass"] < 0.2 * (1 - share["gravity_scale"])


@pytest.mark.slow
def test_one_body_from_its_law_to_its_twin(bar, tmp_path):
    """As the command does it: the law refitted with an effect, a second time from the rollouts on disk, the twin with
    what was accepted, and another condition on top of that."""
    config = RefineConfig.model_validate({"effects": ["viscosity"], "shortlist": 1, "max_effects": 1})
    known = {"poissons_ratio": RATIO}
    simulation = clamped_body_model(bar, "", TRACKS, SIMULATOR, known=known)
    model = Model(family_of("neo_hookean", 1070, known), "none")
    base = gauss_newton_fit(simulation, model, {"youngs_modulus": YOUNGS}, budget=6)
    twin = fitted_twin(described_twin(bar, TRACKS, SIMULATOR), base, simulation, {})
    result = refine_tracks(bar, twin, config, TRACKS, SIMULATOR, folder=tmp_path)
    assert [t.name for t in result.accepted] == ["viscosity"]
    assert result.condition == ""
    assert result.places == {}
    written = document(result)
    assert [(o["observation"], list(o["after_mm"])) for o in written["observations"]] == [
        ("own_a", ["fit"]), ("own_b", ["validation"])
    ]  # fmt: skip
    assert set(arrays(result)) >= {"observed@own_a", "before@own_b", "after@own_b", "times@own_a"}
    again = refine_tracks(bar, twin, config, TRACKS, SIMULATOR, folder=tmp_path)
    assert (again.forward_model.rollouts, again.after.values) == (0, result.after.values)
    refined = refined_twin(twin, result)
    assert [(e.name, e.condition) for e in refined.effects] == [("viscosity", None)]
    assert law_values(refined)["youngs_modulus"] == pytest.approx(YOUNGS, rel=0.02)
    assert twin.effects == ()
    load = RefineConfig.model_validate({"effects": ["gravity_scale"]})
    other = refine_tracks(bar, refined, load, TRACKS, SIMULATOR, condition="load", dry_run=True)
    assert other.verdict == "ranked only"
    assert other.before.model.effects == ("viscosity",)  # what is known acts
    assert [c.effect for c in other.search.rounds[0].candidates] == ["gravity_scale"]
    assert refined_twin(refined, other) is refined


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"particles": 200}, "refine.particles is for scenes of pictures: leave it out, tracks have"),
        ({"laws": ["newtonian"]}, "refine.laws"),
        ({"tracking_error": 0.1}, "refine.tracking_error"),
        ({"processes": 2}, "tracks are simulated in one process"),
        ({"effects": ["ether"]}, "unknown effect 'ether'"),
    ],
)
def test_settings_that_say_nothing_of_tracks_are_refused(bar, settings, words):
    nothing: Any = None
    with pytest.raises(InputError, match=words):
        refine_tracks(bar, nothing, RefineConfig.model_validate(settings), TRACKS, SIMULATOR)


def test_a_place_is_told_in_the_body(bar):
    simulation = clamped_body_model(bar, "load", TRACKS, SIMULATOR, known={"poissons_ratio": RATIO})
    run = simulation.observations[0]
    tip = np.array([0.0, 0.0, 0.05])  # own axes
    placement = next(r for r in bar.runs if r.name == run.name).placement
    x, y, z = simulation.body(run).axes.points_to_simulation(placement.to_world(tip[None]))[0]
    values = {"point_mass.x": float(x), "point_mass.y": float(y), "point_mass.z": float(z)}
    fitted: Any = SimpleNamespace(values=values)
    assert place_of(simulation, "point_mass", fitted) == pytest.approx(tuple(tip), abs=1e-9)
    assert place_of(simulation, "viscosity", fitted) is None


def test_a_static_deflection_strains_as_it_moves(bar):
    """F is the gradient of the displacement, and a section turns without shear."""
    run = next(r for r in bar.runs if r.name == "own_a")
    body = marked_body(bar, run, SIMULATOR, particle_spacing=5e-3)
    axes = clamp_axes(body.gravity, body.clamps[0].normals)
    x, gradient = static_deflection(body.particles, body.clamps[0].heights[0], axes, 2e-3)
    before = body.particles
    assert (x - before).norm(dim=1).max().item() == pytest.approx(2e-3, rel=0.15)
    n, e = axes
    depth = (before @ n).round(decimals=9)
    layers = depth.unique()
    one, two = (torch.nonzero(depth == layers[k])[:, 0] for k in (8, 9))
    order = [
        part[torch.argsort(before[part] @ e * 1e3 + before[part] @ torch.linalg.cross(n, e))] for part in (one, two)
    ]
    step = before[order[1]] - before[order[0]]
    moved = x[order[1]] - x[order[0]]
    mean = 0.5 * (gradient[order[0]] + gradient[order[1]])
    torch.testing.assert_close((mean @ step[:, :, None])[:, :, 0], moved, rtol=0, atol=2e-7)
    strain = 0.5 * (gradient + gradient.mT) - torch.eye(3, dtype=gradient.dtype)
    along = torch.outer(n, n)
    torch.testing.assert_close(strain, torch.einsum("kij,ij->k", strain, along)[:, None, None] * along)


def test_what_the_first_moments_did_to_a_run_is_found_from_the_rest_of_it(bar):
    known = {"poissons_ratio": RATIO, "youngs_modulus": YOUNGS, "viscosity.viscosity": VISCOSITY}
    skipped = replace(bar, runs=tuple(replace(run, ignore_after_release=0.05) for run in bar.runs))
    simulation = clamped_body_model(skipped, "", TRACKS, SIMULATOR, known=known)
    run = next(r for r in simulation.observations if not r.fitted)
    assert run.times[0] >= 0.05
    model = Model(family_of("neo_hookean", 1070, known), "none", ("viscosity",))
    truth = {
        "release": 3e-3, "lateral_offset_1": 4e-4, "lateral_offset_2": -3e-4, "vertical_offset": 1e-3,
        "tip_deflection": -4e-3,
    }  # fmt: skip
    named = {f"{name}@{run.name}": value for name, value in truth.items()}
    parameters = simulation.release_parameters(run)
    assert {p.name for p in parameters} == set(named)
    fitted = replace(run, fit_count=run.time_count)
    seen = simulation.markers(fitted, model, named)
    plain = simulation.markers(fitted, model, dict.fromkeys(named, 0.0))
    assert np.abs(seen - plain).max() > 2e-3
    found, markers = simulation.fit_release(replace(run, values=seen), model, {})
    for p, value in zip(parameters, found, strict=True):
        assert value == pytest.approx(named[p.name], abs=0.2 * p.step), p.name
    np.testing.assert_allclose(markers, seen, atol=1e-5)
    # That of a fitted run is found, too, and not among what is fitted.
    assert not simulation.parameters(model)
    assert gauss_newton_fit(simulation, model, {}, budget=4).fit_mm < 0.1


@pytest.mark.slow
def test_load_is_found_where_the_release_is_not_seen(bar):
    """Out of phase, and with no first moments to count from: from none, its derivative would lead elsewhere."""
    known = {"poissons_ratio": RATIO, "youngs_modulus": YOUNGS, "viscosity.viscosity": VISCOSITY}
    fitted = tuple(replace(run, ignore_after_release=0.04) for run in bar.runs if run.purpose == "fit")
    simulation = clamped_body_model(replace(bar, runs=fitted), "load", TRACKS, SIMULATOR, known=known)
    term = simulation.term("point_mass")
    places = tuple(sorted(term.guesses, key=lambda place: place[2]))  # along the bar, from the clamp
    coarse = replace(term, guesses=(places[0], places[-1]))
    simulation.term = lambda name: coarse if name == "point_mass" else ClampedBodyModel.term(simulation, name)
    base = gauss_newton_fit(
        simulation, Model(family_of("neo_hookean", 1070, known), "none", ("viscosity",)), {}, budget=4
    )
    assert simulation.is_out_of_phase(base.fields)
    assert not simulation.curriculum(base.fields)
    (found,) = score(simulation, base, ["point_mass"], robust_scale=1e-3).candidates
    assert found.finite
    after = fit_with_effect(simulation, base, found, 1e-3)
    assert after.values["point_mass.z"] == places[-1][2]
    assert after.values["point_mass.mass"] == pytest.approx(LOAD, rel=0.1)
    assert after.fit_mm < 0.2 < 0.1 * base.fit_mm


def test_what_acts_on_the_matter_at_a_place_is_in_the_body(bar):
    simulation = clamped_body_model(bar, "", TRACKS, SIMULATOR, known={})
    body = simulation.body(simulation.observations[0])
    particles, face = body.particles.numpy(), 0.5 * (body.volume / len(body.particles)) ** (1 / 3)
    assert 0.001 < face < 0.01
    for name in ("point_mass", "point_force"):
        for p, low, high in zip(simulation.term(name).others, particles.min(0), particles.max(0), strict=True):
            assert (p.lower, p.upper) == pytest.approx((low - face, high + face))
    beside = simulation.term("hidden_obstacle").parameters[-1]
    assert beside.upper > particles.max(0)[2] + 0.01


@pytest.fixture
def masiv(monkeypatch, capfd):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["masiv", *map(str, arguments), "--json"])
        with pytest.raises(SystemExit) as ended:
            main.run()
        out = capfd.readouterr()
        return ended.value.code, json.loads(out.out)

    return run


@pytest.mark.slow
def test_commands_on_a_group(tmp_path, masiv):
    balls = {"heavy": Ball(7.0, 0.2, 0.0), "middle": Ball(0.06, 0.065, 0.4), "light": Ball(0.03, 0.08, 0.7)}
    scene, run = tmp_path / "scene", tmp_path / "run"
    scene.mkdir()
    write_scene(scene, balls)
    code, found = masiv("identify", scene, "--out", run)
    assert (code, found["law"]["kind"]) == (0, "rigid")
    code, found = masiv("refine", run, "--group")
    assert (code, found["verdict"]) == (0, "effect added")
    assert {a["bodies"][0] for a in found["accepted"]} == {"middle", "light"}
    assert found["bodies"]["heavy"]["verdict"] == "nothing missing"
    assert all(a["effect"] == "quadratic_drag" and a["unit"] == {"drag_coefficient": "1"} for a in found["accepted"])
    assert found == json.loads((run / "refine.json").read_text()) | {"refine": str(run / "refine.json")}
    code, found = masiv("evaluate", run)
    light = {r["run"]: r for r in found["held_out"]}["light 2"]
    assert code == 0
    assert light["after_mm"] < 20 < 200 < light["before_mm"]
    code, found = masiv("simulate", run, "--frames", 20, "--out", tmp_path / "moon", "--gravity=0,-1.6,0",
                        "--without", "quadratic_drag")  # fmt: skip
    with np.load(tmp_path / "moon/rollout.npz") as saved:
        fall = saved["markers"][:, found["markers"].index("light"), 1]
        assert saved["positions"].shape == (20, 3, 3)
        np.testing.assert_allclose(np.diff(fall, 2) * 15**2, -1.6, atol=1e-6)
    page = (run / "report.html").read_text()
    assert "Motion of each recording" in page
    assert "quadratic drag (light)" in page.lower()


def test_what_tracks_refuse(tmp_path, masiv):
    write_scene(tmp_path, {"light": Ball(0.03, 0.08, 0.7), "heavy": Ball(7.0, 0.2, 0.0)})
    for more, words in (
        (("--law", "neural"), "use --law auto or a classical law"),
        (("--fit-frames", 3), "--fit-frames is for scenes of pictures"),
    ):
        code, found = masiv("identify", tmp_path, "--out", tmp_path / "run", *more)
        assert code == 2
        assert words in found["error"]
    assert not (tmp_path / "run").exists()
    masiv("identify", tmp_path, "--out", tmp_path / "run")
    for command, words in (
        (("refine", tmp_path / "run", "--condition", "load"), "--condition is for runs of one body"),
        (("simulate", tmp_path / "run", "--frames", 9, "--without", "swirl"), "effects that act on this twin are none"),
        (("simulate", tmp_path / "run", "--frames", 9, "--render"), "--render is for scenes of pictures"),
        (("evaluate", tmp_path / "run", "--truth", tmp_path), "--truth is for scenes of pictures"),
    ):
        code, found = masiv(*command)
        assert code == 2
        assert words in found["error"]


def test_unknown_condition_is_named(bar):
    with pytest.raises(InputError, match="no run of condition 'wind' to fit: its conditions are '', 'load'"):
        clamped_body_model(bar, "wind", TRACKS, SIMULATOR, known={})
