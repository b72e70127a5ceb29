"""Effects in the twin: they act, are kept in twin.yaml, can be left out, and are those that a fit found."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from small import NODES, SMALL, SUBSTEPS
from tiny_scenes import springgaus_synthetic

from masiv.cli import main
from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.errors import InputError, MasivError
from masiv.materials.classical import ClassicalLaw
from masiv.models.filmed_body import FilmedBody
from masiv.models.initial_state import InitialState, rigid_initial_state
from masiv.mpm.design import grid_spacing, substeps_per_frame
from masiv.mpm.simulator import Simulator
from masiv.pipeline import Overrides, open_run
from masiv.report.page import Page
from masiv.report.sections.twin import effects_table
from masiv.runfolder import STAGES
from masiv.scene.scene import Ground, Scene
from masiv.simulation.force import ForcePulse
from masiv.simulation.free_body import iterate_states
from masiv.simulation.simulate import simulate
from masiv.simulation.twin_effects import active_effects, body_mass, shift_effects
from masiv.simulation.variation import with_body_of, with_density, with_ground
from masiv.twin import Twin, TwinEffect

pytestmark = pytest.mark.usefixtures("taichi")
SIDE, FPS = 0.3, 24.0
UP = np.array([0.0, 1.0, 0.0])
GRAVITY = -9.8 * UP
LAW = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)
CONFIG = SMALL
DRAG = TwinEffect("linear_drag", {"rate": 3.0}, {"rate": 0.1})
LATE = TwinEffect("time_offset", {"delay": 0.011})
HIGH = TwinEffect("ground_height", {"height": 0.07})
HEAVY = TwinEffect("point_mass", {"mass": 4.0, "x": 0.2, "y": 0.3, "z": 0.1})


def twin(*effects, **changes):
    axis = (np.arange(6) + 0.5) / 6 * SIDE
    cube = np.stack(np.meshgrid(axis, axis + 0.2, axis, indexing="ij"), -1).reshape(-1, 3)
    settings = dict(
        positions=cube.astype(np.float32), velocity=np.array([0.4, -0.5, 0.0]), omega=np.array([0.0, 1.0, 2.0]),
        gravity=GRAVITY, ground=Ground(UP, 0.0), contact="sticky", friction=0.0, volume=SIDE**3, density=1000.0, up=UP,
        fps=FPS, law=LAW, simulator=CONFIG, effects=effects,
    )  # fmt: skip
    return Twin.of_body(**(settings | changes))


def flying(*effects, **changes):
    return twin(*effects, ground=None, contact="none", **changes)


# ---- they act ------------------------------------------------------------------------------------------------------


def test_without_effects_every_bit_is_that_of_bare_rollouts():
    body, frames = twin(), 7
    state = rigid_initial_state(
        *(torch.as_tensor(v, dtype=torch.float32) for v in (body.positions, body.velocity, body.omega))
    )
    spacing = grid_spacing(body.volume, len(body.positions), CONFIG)
    bare = [state.position]
    for _ in range(1, frames):
        speed = float(state.velocity.norm(dim=1).max()) + 9.8 / FPS
        steps = substeps_per_frame(spacing=spacing, wave_modulus=LAW.wave_modulus(), density=1e3, speed=speed,
                                   frame_time=1 / FPS, config=CONFIG)  # fmt: skip
        simulator = Simulator(particle_count=len(body.positions), spacing=spacing, substep=1 / FPS / steps,
                              volume=body.volume, density=1e3, gravity=GRAVITY, max_substeps=SUBSTEPS,
                              grid_nodes=NODES)  # fmt: skip
        state = simulator.run(state, LAW, steps, []).final
        bare.append(state.position)
    np.testing.assert_array_equal(simulate(body, frames=frames).positions, torch.stack(bare).numpy())
    np.testing.assert_array_equal(torch.stack([s.position for s in iterate_states(body, frames=frames, fps=FPS)]), bare)


def test_a_strong_viscosity_takes_more_substeps():
    """With those of the law alone its flight would not stay rigid."""
    strong = TwinEffect("viscosity", {"viscosity": 3000.0})
    moved = simulate(flying(strong), frames=4).positions
    sizes = np.linalg.norm(moved - moved.mean(1, keepdims=True), axis=2)
    np.testing.assert_allclose(sizes[-1], sizes[0], rtol=0.05)
    few = CONFIG.model_copy(update={"max_substeps_per_frame": 40})
    assert simulate(flying(simulator=few), frames=2).positions.shape[0] == 2
    with pytest.raises(MasivError, match="viscosity as strong as this"):
        simulate(flying(strong, simulator=few), frames=2)


def test_drag_in_free_flight_ends_at_its_terminal_velocity():
    """v = g/k + (v0 - g/k) exp(-k t), and its integral; substeps of h take g h / 2 off the speed."""
    k, frames = 6.0, 25
    body = flying(TwinEffect("linear_drag", {"rate": k}))
    path = simulate(body, frames=frames, substeps=200).positions.astype(np.float64).mean(1)
    t = np.arange(frames)[:, None] / FPS
    final = GRAVITY / k
    exact = path[0] + final * t + (body.velocity - final) * (1 - np.exp(-k * t)) / k
    np.testing.assert_allclose(path, exact, atol=1e-3)
    np.testing.assert_allclose((path[-1] - path[-2]) * FPS, final, atol=0.01)


def test_ground_is_raised_and_frames_come_late():
    low, high = simulate(twin(), frames=16).positions, simulate(twin(HIGH), frames=16).positions
    np.testing.assert_array_equal(low[0], high[0])
    assert high[-1][:, 1].min() - low[-1][:, 1].min() == pytest.approx(0.07, abs=0.02)
    fall = flying(replace(LATE, values={"delay": 0.05}), omega=np.zeros(3))  # later than a frame
    motion = simulate(fall, frames=5, substeps=100)
    t = np.concatenate([[0], np.arange(1, 5) / FPS + 0.05])[:, None]
    exact = fall.positions.mean(0) + fall.velocity * t + 0.5 * GRAVITY * t**2
    np.testing.assert_allclose(motion.positions.mean(1), exact, atol=6e-4)
    np.testing.assert_allclose(motion.times, np.arange(5) / FPS)
    early = simulate(replace(fall, effects=(TwinEffect("time_offset", {"delay": -0.06}),)), frames=4).positions
    np.testing.assert_array_equal(early[1], early[0])  # not before the start
    np.testing.assert_allclose(early[3].mean(0)[0] - early[0].mean(0)[0], 0.4 * (3 / FPS - 0.06), atol=1e-4)
    for count in (1, 2):
        assert len(simulate(fall, frames=count).positions) == count


def test_a_force_that_depends_on_time_goes_on_over_frames():
    """dv/dt = A cos(2 pi f t) from v0 = 0: x = A (1 - cos(w t)) / w^2, over a period and a half."""
    values = {p.name: 0.0 for p in effect_named("periodic_force").parameters}
    values |= {"cosine_x": 5.0, "frequency": 3.0}
    still = dict(velocity=np.zeros(3), omega=np.zeros(3), gravity=np.zeros(3))
    body = flying(TwinEffect("periodic_force", values), **still)
    for push in (None, ForcePulse(np.zeros(3), 0.03, 0.11)):  # cuts frames into pieces
        moved = simulate(body, frames=13, force=push).positions[:, :, 0].mean(1)
        w, t = 2 * math.pi * 3.0, np.arange(13) / FPS
        np.testing.assert_allclose(moved - moved[0], 5.0 * (1 - np.cos(w * t)) / w**2, atol=6e-4)


def test_a_push_moves_what_is_added_to_the_mass_too():
    values = dict(zip("xyz", (0.15, 0.35, 0.15), strict=True))
    heavy = flying(TwinEffect("point_mass", {"mass": 13.5, **values}), gravity=np.zeros(3), omega=np.zeros(3))
    assert body_mass(heavy) == pytest.approx(27 + 13.5, rel=1e-5)
    assert body_mass(replace(heavy, effects=())) == pytest.approx(27)
    path = simulate(heavy, frames=6, force=ForcePulse(np.array([81.0, 0, 0]))).positions
    held = heavy.positions.astype(float)
    radius = active_effects(heavy, frames=2, fps=FPS).context.size / 8
    share = np.exp(-0.5 * ((held - held.mean(0)) ** 2).sum(1) / radius**2)
    weight = 27 / len(held) + 13.5 * share / share.sum()
    centre = (path[:, :, 0] * weight).sum(1) / weight.sum()
    t = np.arange(6) / FPS
    np.testing.assert_allclose(centre - centre[0], 0.4 * t + 0.5 * 2.0 * t**2, atol=2e-3)


def test_what_cannot_be_at_once():
    both = twin(TwinEffect("ground_friction", {"slipperiness": 1.0}), TwinEffect("restitution", {"coefficient": 0.5}))
    with pytest.raises(InputError, match="both replace the contact"):
        simulate(both, frames=2)
    with pytest.raises(InputError, match="--gravity takes"):
        simulate(twin(DRAG), frames=2, gravity=np.zeros(2))
    with pytest.raises(InputError, match="--frames 0"):
        simulate(twin(DRAG), frames=0)


# ---- another situation ---------------------------------------------------------------------------------------------


def obstacle(height):
    return TwinEffect("hidden_obstacle", {"radius": 0.1, "x": 0.15, "y": height, "z": 0.15})


def test_places_stay_in_the_world():
    body = twin(obstacle(0.05), ground=Ground(UP, 0.1), positions=twin().positions + np.float32(0.2) * UP.astype("f4"))
    for varied in (with_ground(body, "none"), with_ground(body, "-0.4"), with_density(body, 500.0)):
        height = 0.0 if varied.ground is None else varied.ground.height
        assert varied.effects[0].values["y"] + height == pytest.approx(0.15)
    deep = -11 * grid_spacing(body.volume, len(body.positions), CONFIG)  # nodes of the grid where they were
    free, low = (simulate(with_ground(body, g), frames=9).positions for g in ("none", str(deep)))
    np.testing.assert_allclose(free, low, atol=1e-3)
    gone = simulate(with_ground(body, "none"), frames=9, without=("hidden_obstacle",)).positions
    assert np.abs(free - gone).max() > 0.05
    other, _ = with_body_of(body, twin())
    assert other.effects == body.effects
    # An effect that raises the ground takes no place with it, and a ground that is asked for is where it is put.
    raised = replace(body, effects=(*body.effects, HIGH))
    theta = active_effects(raised, frames=2, fps=FPS)
    assert float(shift_effects(theta, theta.ground_shift()).members[0][1][2]) == pytest.approx(0.05 - 0.07)
    assert with_ground(raised, "0.05").effects == with_ground(body, "0.05").effects
    assert raised.effects[0].values["y"] == 0.05


def test_gravity_scale_is_of_the_gravity_that_acts():
    buoyant = flying(TwinEffect("gravity_scale", {"relative_change": -1.0}), omega=np.zeros(3))
    for gravity in (None, np.array([0, -1.6, 0.5])):
        path = simulate(buoyant, frames=5, gravity=gravity).positions.mean(1)
        np.testing.assert_allclose(path[4] - path[0], buoyant.velocity * 4 / FPS, atol=1e-5)


def test_without_removes():
    body = twin(DRAG, LATE, HIGH)
    bare = simulate(twin(), frames=5).positions
    names = ("linear_drag", "time_offset", "ground_height")
    np.testing.assert_array_equal(simulate(body, frames=5, without=names).positions, bare)
    some = simulate(body, frames=5, without=("time_offset",)).positions
    np.testing.assert_array_equal(some, simulate(twin(DRAG, HIGH), frames=5).positions)
    assert np.abs(some - bare).max() > 0.01
    with pytest.raises(InputError, match=r"--without swirl: .* linear_drag, time_offset, ground_height"):
        simulate(body, frames=5, without=("swirl",))
    with pytest.raises(InputError, match=r"--without swirl: .* none"):
        simulate(twin(), frames=5, without=("swirl",))


# ---- the same as the fit's -----------------------------------------------------------------------------------------


class Still:
    """A trajectory of which only the start and the volume matter."""

    def __init__(self, body, frames):
        self.positions = np.broadcast_to(body.positions, (frames, *body.positions.shape))
        self.times, self.volume = np.arange(frames) / FPS, body.volume

    def evaluate(self, times):
        return np.array(np.broadcast_to(self.positions[0], (len(times), *self.positions.shape[1:])))


def fitted(body, frames, steps):
    """Positions (T, N, 3) of the same body, throw and effects as a fit simulates them."""

    def no_picture(view, frame):
        raise AssertionError("no pictures here")

    scene = Scene(
        path=Path("simulated"), layout="none", fps=FPS, frame_count=frames, cameras=(), gravity=body.gravity,
        up=body.up, ground=body.ground, density=body.density, load=no_picture, mask_source="none",
    )  # fmt: skip
    problem = FilmedBody(scene, Still(body, frames), CONFIG, samples=2)
    members = [(effect_named(e.name), torch.tensor(list(e.values.values()))) for e in body.effects]
    throw = InitialState(*(torch.tensor(v, dtype=torch.float32) for v in (body.velocity, body.omega, 0.0)))
    effects = ActiveEffects(tuple(members), problem.context()) if members else None
    with torch.no_grad():
        moved = problem.run(body.law, throw, body.contact, frames - 1, steps, effects)
    return torch.cat([problem.particles[None], moved[1::2]]).numpy()


@pytest.mark.parametrize(
    "effects",
    [
        (DRAG, LATE, HIGH),
        (DRAG, replace(LATE, values={"delay": -0.017}), HIGH),
        (replace(LATE, values={"delay": 0.06}),),
        (TwinEffect("viscosity", {"viscosity": 20.0}), HEAVY),
        (),
    ],
    ids=lambda effects: "+".join(f"{e.name}{e.values.get('delay', '')}" for e in effects) or "none",
)
def test_the_twin_moves_as_the_fit_did(effects):
    body, frames, steps = twin(*effects), 10, 48
    same = simulate(body, frames=frames, substeps=steps).positions
    np.testing.assert_allclose(same, fitted(body, frames, steps), rtol=0, atol=3e-7)  # a few roundings of float32
    # The landing depends on the substep to about 2 % of the body's side, whichever way it changes.
    for other in (2 * steps, None):
        difference = np.linalg.norm(simulate(body, frames=frames, substeps=other).positions - same, axis=2).mean()
        assert difference < 0.03 * SIDE


# ---- twin.yaml, the command, the report ----------------------------------------------------------------------------


def test_round_trip(tmp_path):
    body = twin(DRAG, LATE)
    # numpy's scalars, as arithmetic with arrays gives
    body = body.with_body(volume=np.float64(body.volume)).with_motion(fps=np.float64(body.fps))
    body.save(tmp_path)
    document = yaml.safe_load((tmp_path / "twin.yaml").read_text())
    everywhere = {"bodies": [], "condition": None, "place": None}
    assert document["effects"] == [
        {"effect": "linear_drag", "parameters": {"rate": {"value": 3.0, "unit": "1/s", "stderr": 0.1}}, **everywhere},
        {"effect": "time_offset", "parameters": {"delay": {"value": 0.011, "unit": "s", "stderr": None}}, **everywhere},
    ]
    again = Twin.load(tmp_path)
    assert again.effects == (DRAG, replace(LATE, stderr={"delay": None}))
    np.testing.assert_array_equal(simulate(again, frames=3).positions, simulate(body, frames=3).positions)
    twin().save(tmp_path)
    assert yaml.safe_load((tmp_path / "twin.yaml").read_text())["effects"] == []
    assert Twin.load(tmp_path).effects == ()


def test_the_command_leaves_effects_out(tmp_path, monkeypatch, capfd):
    run = open_run(springgaus_synthetic(tmp_path / "scene"), tmp_path / "run", Overrides("quick")).folder
    for stage in STAGES:
        with run.stage(stage):
            pass
    twin(DRAG, HIGH).save(run.path)

    def command(*more):
        arguments = ["simulate", run.path, "--frames", 4, "--json", "--out", tmp_path / "novel", *more]
        monkeypatch.setattr(sys, "argv", ["masiv", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main.run()
        out, err = capfd.readouterr()
        if ended.value.code:
            return ended.value.code, err
        data = json.loads(out)
        return data["effects"], np.load(data["rollout"])["positions"]

    names, with_all = command()
    assert names == ["linear_drag", "ground_height"]
    names, without = command("--without", "linear_drag", "--without", "ground_height")
    assert names == []
    assert np.abs(with_all - without).max() > 1e-3
    code, message = command("--without", "swirl")
    assert code == 2
    assert "linear_drag, ground_height" in message


def test_the_report_lists_effects(tmp_path):
    page = Page("twin")
    effects_table(page, twin())
    assert page.parts == []
    effects_table(page, twin(DRAG, LATE))
    text = "".join(page.parts)
    for part in ("linear drag", "rate", "3", "1/s", "0.1", "delay", "0.011", "–"):
        assert f">{part}<" in text
