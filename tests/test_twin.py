"""twin.yaml: what is written is read again, of schema 1 too, and what is wrong in it is named."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from masiv.effects.catalogue import effects
from masiv.effects.per_body import DragBody
from masiv.errors import InputError
from masiv.materials.classical import PARAMETERS, RANGES, ClassicalLaw
from masiv.mpm.config import SimulatorConfig
from masiv.scene.scene import Ground
from masiv.simulation.fitted_twin import law_values
from masiv.tracks.placement import Placement
from masiv.tracks.tracks import Clamp
from masiv.twin import Body, Boundary, InitialCondition, Release, Twin, TwinEffect
from masiv.twin.body import OFFSET_UNITS
from masiv.twin.identified import IDENTIFIED_FILE, load_identified, load_to_refine, restore_identified, save_refined

SCHEMA1 = Path(__file__).parent / "data/twin_schema1"
UP = np.array([0.0, 1.0, 0.0])


# ---- round trips ---------------------------------------------------------------------------------------------------

numbers = st.floats(-5e3, 5e3, allow_subnormal=False)  # Taichi makes its process flush them to zero
positive = st.floats(1e-6, 1e6)
volumes, densities, rates = st.floats(1e-6, 1), st.floats(0.01, 3e4), st.floats(0.01, 1e6)
frictions = st.floats(0, 10, allow_subnormal=False)
CORNERS = np.concatenate([np.zeros((1, 3)), 2 * np.eye(3)])
"""Of a box that is larger than any of ``volumes``."""
vectors = arrays(np.float64, 3, elements=numbers)
names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)


@st.composite
def laws(draw):
    kind = draw(st.sampled_from(sorted(PARAMETERS)))
    inside = {"exclude_min": True, "exclude_max": True, "allow_subnormal": False}
    values = {name: draw(st.floats(*RANGES.get(name, (1e-3, 1e8)), **inside)) for name in PARAMETERS[kind]}
    law = ClassicalLaw(kind, **values)
    law.stderr = {name: draw(positive) for name in values if draw(st.booleans())}
    return law


@st.composite
def bodies(draw, name):
    drag = DragBody(*draw(st.tuples(positive, positive, positive, positive)))
    clamp = Clamp(draw(vectors)[None], draw(arrays(np.float64, 1, elements=numbers)), ("base",))
    if draw(st.booleans()):
        return Body(name, draw(volumes), draw(densities), geometry="sphere", drag=drag)
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    moved = draw(arrays(np.float64, (4, 3), elements=st.floats(-0.4, 0.4, allow_subnormal=False)))
    particles = (CORNERS + moved).astype(dtype)
    return Body(
        name, draw(volumes), draw(densities), draw(laws()), particles, draw(st.none() | positive),
        draw(st.sampled_from([(), (clamp,), (clamp, clamp)])), draw(st.none() | names), draw(st.none() | st.just(drag)),
    )  # fmt: skip


@st.composite
def twin_effects(draw, of):
    effect = draw(st.sampled_from(list(effects().values())))
    parameters = (effect.per_body if effect.per_body and draw(st.booleans()) else effect).parameters
    values = {p.name: draw(st.floats(p.lower, p.upper, allow_subnormal=False)) for p in parameters}
    stderr = {p.name: draw(st.none() | positive) for p in parameters}
    place = tuple(draw(vectors).tolist()) if draw(st.booleans()) else None
    return TwinEffect(effect.name, values, stderr, draw(st.sampled_from([(), of])), draw(st.none() | names), place)


@st.composite
def twins(draw):
    known = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    starts = []
    for index, body in enumerate(known):
        placement = Placement(np.eye(3), draw(vectors), draw(positive))
        release = Release(
            {"tip": draw(vectors)},
            draw(positive),
            {name: draw(numbers) for name in OFFSET_UNITS if draw(st.booleans())},
        )
        starts.append(
            InitialCondition(
                f"run {index}",
                body,
                draw(rates),
                draw(vectors),
                draw(vectors),
                draw(names),
                draw(st.none() | st.just(placement)),
                draw(st.none() | st.just(release)),
            )
        )
    ground = Ground(UP, draw(st.floats(-5e3, -1))) if draw(st.booleans()) else None
    return Twin(
        bodies=tuple(draw(bodies(name)) for name in known),
        boundary=Boundary(ground, draw(st.sampled_from(["sticky", "release", "slip", "none"])), draw(frictions)),
        gravity=draw(vectors),
        up=UP,
        initial_conditions=tuple(starts),
        simulator=SimulatorConfig.model_validate({"chunks": draw(st.integers(1, 8))}),
        effects=tuple(draw(st.lists(twin_effects((known[0],)), max_size=2, unique_by=lambda effect: effect.name))),
        fit={"error_mm": draw(st.none() | numbers), "law": draw(names)},
    )


@settings(max_examples=60, deadline=None)
@given(twins())
def test_what_is_written_is_read_again(tmp_path_factory, twin):
    folder = tmp_path_factory.mktemp("twin")
    twin.save(folder)
    assert_same(Twin.load(folder), twin)
    assert not list(folder.glob("*tmp*"))


def assert_same(one, other):
    """Equal to the last digit, arrays by type, laws by their parameters."""
    if isinstance(other, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    elif isinstance(other, ClassicalLaw):
        assert (one.description(), one.stderr) == (other.description(), other.stderr)
    elif isinstance(other, (tuple, list)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(other, dict):
        assert set(one) == set(other)
        for key in other:
            assert_same(one[key], other[key])
    elif hasattr(other, "__dataclass_fields__"):
        assert type(one) is type(other)
        assert_same(vars(one), vars(other))
    else:
        assert one == other


# ---- schema 1 ------------------------------------------------------------------------------------------------------


def test_a_filmed_body_of_schema_1(tmp_path):
    twin = Twin.load(SCHEMA1 / "video")
    assert twin.law.description()["parameters"]["yield_stress"] == {"value": 850.0, "unit": "Pa", "stderr": 41.5}
    assert (twin.volume, twin.density, twin.fps, twin.contact, twin.friction) == (0.001, 1100.0, 24.0, "slip", 0.2)
    assert twin.ground is not None
    assert twin.ground.height == 0.013
    np.testing.assert_array_equal(twin.velocity, [0.4, -0.5, 0.1])
    np.testing.assert_array_equal(twin.omega, [0.0, 1.0, 2.0])
    assert twin.positions.shape == (8, 3)
    assert twin.positions.dtype == np.float32
    assert [effect.rows() for effect in twin.effects] == [
        [("rate", 3.0, "1/s", 0.1)], [("delay", 0.011, "s", None)]
    ]  # fmt: skip
    assert twin.fit["history"] == [1.0, None]
    assert twin.simulator.subparticles == 4
    twin.save(tmp_path)
    assert yaml.safe_load((tmp_path / "twin.yaml").read_text())["schema"] == 2
    assert_same(Twin.load(tmp_path), twin)


def described(rigid):
    """What a scene of tracks says of the twins in the files."""
    if rigid:
        bodies = tuple(Body(n, 1e-3, 60.0, drag=DragBody(0.1, 0.06, 1.2, 1.8e-5)) for n in ("light", "middle"))
        starts = [InitialCondition(f"{b.name} 1", b.name, 15.0, np.zeros(3), np.zeros(3)) for b in bodies]
        starts = [replace(s, placement=Placement(np.eye(3), np.array([0.5, 2.2, 0.0]))) for s in starts]
    else:
        bodies = (Body("bar", 9e-5, 1070.0, None, np.diag([0.03, 0.03, 0.1, 0.0])[:, :3], 0.01),)
        rest = Placement(np.eye(3), np.zeros(3))
        starts = [
            InitialCondition(name, "bar", 100.0, np.zeros(3), np.zeros(3), condition, rest, Release({"a": UP}, 1.0))
            for name, condition in (("own_a", ""), ("load_a", "load"))
        ]
    return Twin(bodies, Boundary(), -9.8 * UP, UP, tuple(starts), SimulatorConfig())


def test_a_clamped_body_of_schema_1(tmp_path):
    twin = Twin.load(SCHEMA1 / "clamped", scene=lambda: described(rigid=False))
    assert isinstance(twin.law, ClassicalLaw)
    assert law_values(twin) == {"poissons_ratio": 0.2, "youngs_modulus": 201234.5}
    assert twin.law.stderr == {"youngs_modulus": 1234.0}
    own, load = twin.initial_conditions
    assert own.release is not None
    assert load.release is not None
    assert own.release.offsets == {"release": 0.0012, "lateral_offset_1": 1.5e-4, "lateral_offset_2": -2e-5}
    assert load.release.offsets == {"release": -0.0004}
    viscosity, mass = twin.effects
    assert (viscosity.condition, mass.condition, mass.place) == (None, "load", (0.001, -0.002, 0.049))
    assert mass.rows()[-1] == ("z", 0.049, "m", None)
    assert [e.name for e in twin.in_condition().effects] == ["viscosity"]
    assert [e.name for e in twin.in_condition("load").effects] == ["viscosity", "point_mass"]
    twin.save(tmp_path)
    assert_same(Twin.load(tmp_path), twin)


def test_a_group_of_schema_1(tmp_path):
    twin = Twin.load(SCHEMA1 / "group", scene=lambda: described(rigid=True))
    assert twin.rigid
    light, middle = twin.initial_conditions
    assert light.placement is not None
    np.testing.assert_array_equal(light.placement.translation, [0.5, 1.99, 0.0])
    np.testing.assert_array_equal(middle.velocity, [0.0, -0.49, 0.0])
    assert [(e.name, e.bodies, e.values, e.shared) for e in twin.effects] == [
        ("quadratic_drag", ("light",), {"drag_coefficient": 0.71}, True),
        ("quadratic_drag", ("middle",), {"drag_coefficient": 0.42}, True),
    ]
    twin.save(tmp_path)
    assert_same(Twin.load(tmp_path), twin)


def test_tracks_of_schema_1_need_their_scene():
    with pytest.raises(InputError, match=r"group/twin\.yaml is of schema 1.*load it with its scene"):
        Twin.load(SCHEMA1 / "group")


# ---- refusals ------------------------------------------------------------------------------------------------------

RATE = {"value": 1.0, "unit": "1/s", "stderr": None}


def drag(**parameters):
    return {"effect": "linear_drag", "parameters": parameters}


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("schema",), 3, "has schema 3, this masiv reads 1 and 2"),
        (("colour",), "red", "unknown key 'colour'"),
        (("bodies",), [], "'bodies' is .*at least 1 item"),
        (("bodies", 0, "volume", "value"), -1.0, "'bodies.0.volume.value' is -1.0: .*greater than 0"),
        (("bodies", 0, "volume", "value"), math.nan, r"'bodies.0.volume.value' is nan: .*finite"),
        (("bodies", 0, "volume", "value"), "1", r"'bodies.0.volume.value' is '1': .*valid number"),
        (("bodies", 0, "volume", "unit"), "cm^3", r"'bodies.0.volume.unit' is 'cm\^3'"),
        (("bodies", 0, "mass"), 3.0, "unknown key 'bodies.0.mass'"),
        (
            ("bodies", 0, "law", "kind"),
            "water",
            r"law.kind' is 'water', but law.safetensors holds a von_mises",
        ),
        (
            ("bodies", 0, "law", "parameters", "yield_stress", "value"),
            90.0,
            "yield_stress.value' is 90.0, but law.safetensors holds 850",
        ),
        (("bodies", 0, "law", "parameters"), {}, "parameters.* is None, but law.safetensors holds"),
        (("bodies", 0, "law", "file"), "../law.safetensors", "'bodies.0.law.file' is '../law.safetensors'"),
        (("bodies", 0, "law", "file"), "none.safetensors", "none.safetensors is not a law"),
        (("bodies", 0, "particles"), None, "'bodies.0.particles' is missing"),
        (("bodies", 0, "particles", "tensor"), "other", "does not hold the particles of body 'other'"),
        (("boundary", "contact"), "glue", "'boundary.contact' is 'glue': .*'sticky'"),
        (("boundary", "friction"), -0.1, "'boundary.friction' is -0.1"),
        (("boundary", "friction"), True, "'boundary.friction' is True"),
        (("boundary", "ground", "normal"), [0.0, 1.0], "'boundary.ground.normal' is .*at least 3"),
        (("gravity", "value"), [0.0, "down", 0.0], "'gravity.value.1' is 'down'"),
        (("initial_conditions",), [], "'initial_conditions' is"),
        (("initial_conditions", 0, "fps"), 0.0, "'initial_conditions.0.fps' is 0.0"),
        (("initial_conditions", 0, "body"), "other", "'initial_conditions.0.body' is 'other': bodies are body"),
        (("simulator", "chunks"), 0, "'simulator.chunks' is 0"),
        (("effects",), {}, "'effects' is {}: input should be a valid list"),
        (("effects",), [{"effect": "linear_drag"}], "'effects.0.parameters' is"),
        (("effects",), [{"effect": "drag", "parameters": {}}], "'effects.0.effect' is 'drag': unknown effect"),
        (("effects",), [drag(rat=RATE)], "'effects.0.parameters.rat' is unknown: linear_drag has the parameters rate"),
        (("effects",), [drag()], "'effects.0.parameters.rate' is missing"),
        (("effects",), [drag(rate=RATE | {"value": -1.0})], "rate.value' is -1.0: it must lie between 0 and"),
        (("effects",), [drag(rate=RATE | {"value": math.nan})], "rate.value' is nan"),
        (("effects",), [drag(rate=RATE | {"value": True})], "rate.value' is True"),
        (("effects",), [drag(rate=RATE | {"unit": "1/min"})], "rate.unit' is '1/min': it must be 1/s"),
        (("effects",), [drag(rate=RATE | {"stderr": "small"})], "rate.stderr' is 'small'"),
        (("effects",), [drag(rate=RATE | {"stderr": -1.0})], "rate.stderr' is -1.0"),
        (("effects",), [drag(rate=RATE) | {"bodies": ["moon"]}], "'effects.0.bodies' has 'moon': bodies are body"),
        (("effects",), 2 * [drag(rate=RATE)], "'effects.1.effect': linear_drag is there twice"),
        (("effects",), [drag(rate=RATE), drag(rate=RATE) | {"condition": "load"}], "there twice"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, path, value, message):
    Twin.load(SCHEMA1 / "video").save(tmp_path)
    document = yaml.safe_load((tmp_path / "twin.yaml").read_text())
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=message) as failed:
        Twin.load(tmp_path)
    assert "\n" not in str(failed.value)
    if "safetensors" not in message:
        assert str(tmp_path) in str(failed.value)


def test_one_effect_for_several_bodies_and_conditions():
    """The same effect may act twice if it does not act on one body at once."""
    light, heavy = (TwinEffect("linear_drag", {"rate": 1.0}, bodies=(name,)) for name in ("light", "heavy"))
    assert not light.overlaps(heavy)
    assert not replace(light, condition="wind").overlaps(replace(light, condition="load"))
    assert light.overlaps(replace(light, condition="load"))
    assert light.overlaps(replace(heavy, bodies=()))


@pytest.mark.parametrize(("text", "message"), [(None, "holds no twin.yaml"), ("[", "is not valid YAML"), ("3", "key")])
def test_what_is_no_twin(tmp_path, text, message):
    if text is not None:
        (tmp_path / "twin.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        Twin.load(tmp_path)


def test_particles_that_are_not_finite(tmp_path):
    twin = Twin.load(SCHEMA1 / "video")
    twin.with_body(particles=np.full((4, 3), np.nan, np.float32)).save(tmp_path)
    with pytest.raises(InputError, match=r"particles\.safetensors .* has a number that is not finite"):
        Twin.load(tmp_path)


# ---- one body, several bodies, conditions --------------------------------------------------------------------------


def test_the_properties_of_one_body_are_refused_for_several():
    twin = described(rigid=True)
    with pytest.raises(InputError, match="the twin has 2 bodies: light, middle"):
        _ = twin.density
    with pytest.raises(InputError, match="body light of the twin is rigid: it has no law"):
        _ = replace(twin, bodies=twin.bodies[:1]).law
    with pytest.raises(InputError, match="no initial condition under 'wind': its conditions are '', 'load'"):
        described(rigid=False).in_condition("wind")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda twin: replace(twin, gravity=np.zeros(2)), r"gravity has shape \(2,\), it must be \(3,\)"),
        (lambda twin: twin.with_motion(velocity=np.zeros((1, 3))), r"velocity in .* has shape \(1, 3\)"),
        (lambda twin: twin.with_body(particles=np.zeros((3, 4))), r"particles of body .* it must be \(Q, 3\)"),
    ],
)
def test_a_wrong_shape_is_refused_at_once(make, message):
    with pytest.raises(InputError, match=message):
        make(Twin.load(SCHEMA1 / "video"))


# ---- before and after refine ---------------------------------------------------------------------------------------

LOAD = TwinEffect("point_mass", {"mass": 0.04, "x": 0.0, "y": 0.0, "z": 0.05}, condition="load")
DRAG = TwinEffect("linear_drag", {"rate": 2.0})


def test_refine_starts_again_from_what_identify_found(tmp_path):
    """Another refine starts without what an earlier one added in its condition, and undoing it gives the old twin."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)
    softer = ClassicalLaw("neo_hookean", youngs_modulus=1e4, poissons_ratio=0.3)
    identified = described(rigid=False).with_body(law=law)
    identified.save(tmp_path)
    assert_same(load_identified(tmp_path), identified)
    save_refined(tmp_path, replace(identified, effects=(DRAG,)).with_body(law=softer))
    save_refined(tmp_path, replace(Twin.load(tmp_path), effects=(DRAG, LOAD)))  # the first one's copy stays
    assert_same(load_identified(tmp_path), identified)
    again = load_to_refine(tmp_path)
    assert [e.name for e in again.effects] == ["point_mass"]
    assert_same(again.law, law)
    other = load_to_refine(tmp_path, "load")
    assert [e.name for e in other.effects] == ["linear_drag"]
    assert_same(other.law, softer)
    restore_identified(tmp_path)
    assert not (tmp_path / IDENTIFIED_FILE).exists()
    assert_same(Twin.load(tmp_path), identified)


def test_what_identify_found_is_kept_of_schema_1_too(tmp_path):
    shutil.copytree(SCHEMA1 / "video", tmp_path / "run")
    before = Twin.load(tmp_path / "run")
    save_refined(tmp_path / "run", replace(before, effects=()))
    assert_same(load_identified(tmp_path / "run"), before)
    assert Twin.load(tmp_path / "run").effects == ()
