"""How many substeps a law with effects needs: bounds against rollouts on either side of them."""

from __future__ import annotations

import math

import pytest
import torch
from small import NODES, SMALL, SUBSTEPS

from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effect_named
from masiv.effects.context import EffectContext
from masiv.effects.stability import SubstepDemand
from masiv.errors import MasivError, NonFiniteError
from masiv.materials.classical import ClassicalLaw
from masiv.models.deformable import halved
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.design import HELD_MARGIN, substeps_per_frame, viscous_substep
from masiv.mpm.rollout import at_rest
from masiv.mpm.simulator import Simulator

F64 = torch.float64
SPACING, DENSITY, VISCOSITY = 0.04, 1e3, 50.0
LIMIT = DENSITY * SPACING**2 / (4 * VISCOSITY)
"""[s] of explicit diffusion for any arrangement of particles."""
SOFT = ClassicalLaw("neo_hookean", youngs_modulus=1e-6, poissons_ratio=0.3)


def effects_on(x, **thetas):
    context = EffectContext(torch.tensor([0.0, -9.8, 0.0], dtype=x.dtype), x, DENSITY * SPACING**3 / 8, 0.2, 1.0)
    members = [(effect_named(name), torch.tensor(theta, dtype=x.dtype)) for name, theta in thetas.items()]
    return ActiveEffects(tuple(members), context)


def growth(x, share, velocity, affine):
    """Size of the affine velocities after 40 substeps of ``share`` times LIMIT, without weight, over that at first."""
    sim = Simulator(particle_count=len(x), spacing=SPACING, substep=share * LIMIT, volume=len(x) * SPACING**3 / 8,
                    density=DENSITY, gravity=(0, 0, 0), contact="none", dtype=F64, max_substeps=SUBSTEPS,
                    grid_nodes=NODES)  # fmt: skip
    end = sim.run(at_rest(x, velocity, affine), SOFT, 40, [40], effects_on(x, viscosity=[VISCOSITY])).final
    return float(end.affine_velocity.norm() / affine.norm())


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize("share", [0.7, 0.95, 1.05, 1.2])
def test_a_lone_particle_attains_the_limit_of_viscosity(share):
    """In the middle of a cell it is alone with its nodes: each substep multiplies its shear by 1 - 2 share."""
    x = torch.full((1, 3), 5.5 * SPACING, dtype=F64)
    shear = 1e-9 * torch.diag(torch.tensor([1.0, 1.0, -2.0], dtype=F64))[None]
    found = growth(x, share, torch.zeros(1, 3, dtype=F64), shear)
    assert found == pytest.approx(abs(1 - 2 * share) ** 40, rel=1e-3, abs=1e-5)


@pytest.mark.usefixtures("taichi")
def test_filled_cells_stay_bounded_within_the_limit_and_not_far_beyond_it():
    generator = torch.Generator().manual_seed(3)
    x = (5 + 4 * torch.rand(512, 3, generator=generator, dtype=F64)) * SPACING
    affine = 1e-9 * torch.randn(512, 3, 3, generator=generator, dtype=F64)
    velocity = 1e-9 * SPACING * torch.randn(512, 3, generator=generator, dtype=F64)
    assert growth(x, 0.98, velocity, affine) < 1.0
    try:
        assert growth(x, 2.6, velocity, affine) > 1e3
    except NonFiniteError:
        pass


@pytest.mark.usefixtures("taichi")
@pytest.mark.parametrize(
    "thetas",
    [
        {"viscosity": [500.0]},
        {"stiffness_contrast": [2.0, 0.1, 0.12, 0.1, 0.15]},
        {"viscosity": [500.0], "stiffness_contrast": [2.0, 0.1, 0.12, 0.1, 0.15]},
        {"anisotropy": [1e6, 0.3, 0.5]},
    ],
)
@pytest.mark.parametrize("margin", [1.0, HELD_MARGIN])
def test_the_strongest_effects_stay_bounded_with_the_substeps_that_they_ask_for(thetas, margin):
    """At the bounds of their parameters, on a body that lands; also with the longest substep that may be held."""
    generator = torch.Generator().manual_seed(1)
    x = 0.2 * torch.rand(512, 3, generator=generator, dtype=F64)
    x[:, 1] += 0.02
    law = ClassicalLaw("neo_hookean", youngs_modulus=3e4, poissons_ratio=0.3)
    acting = effects_on(x, **thetas)
    speed, frame_time = 3.0, 1 / 24
    needed = substeps_per_frame(
        spacing=SPACING, wave_modulus=law.wave_modulus(), density=DENSITY, speed=speed, frame_time=frame_time,
        config=SMALL.model_copy(update={"max_substeps_per_frame": 4000}), demand=acting.substep_demand(),
    )  # fmt: skip
    steps = math.ceil(needed / margin)
    volume = 512 * SPACING**3 / 8
    sim = Simulator(particle_count=512, spacing=SPACING, substep=frame_time / steps, volume=volume, density=DENSITY,
                    gravity=(0, -9.8, 0), contact="sticky", dtype=F64, max_substeps=SUBSTEPS,
                    grid_nodes=NODES)  # fmt: skip
    start = rigid_initial_state(x, torch.tensor([0.3, -2.0, 0.0], dtype=F64), torch.tensor([0.0, 0.0, 3.0], dtype=F64))
    state, energies = start, []
    for _ in range(3):
        state = sim.run(state, law, steps, [steps], acting).final
        energies.append(float(0.5 * (state.velocity**2).sum(1).mean()))
    # Neither the law nor the viscosity gives energy: what a particle has is its speed at first and its fall.
    most = float(0.5 * (start.velocity**2).sum(1).mean()) + 9.8 * 0.22
    assert max(energies) < most
    assert state.affine_velocity.abs().max() < 2 * speed / SPACING


def count(demand, **changes):
    kind = dict(spacing=0.03, wave_modulus=4e4, density=DENSITY, speed=4.0, frame_time=1 / 24, config=SMALL)
    return substeps_per_frame(**{**kind, **changes}, demand=demand)


def test_weak_effects_ask_for_nothing_and_strong_ones_by_the_law_of_diffusion():
    plain = count(SubstepDemand())
    assert count(SubstepDemand(viscosity=20.0)) == plain
    strong, finer = count(SubstepDemand(viscosity=400.0)), count(SubstepDemand(viscosity=400.0), spacing=0.025)
    assert strong > plain
    assert finer / strong == pytest.approx((0.03 / 0.025) ** 2, rel=0.01)
    assert count(SubstepDemand(modulus_factor=4.0), speed=0.0) == pytest.approx(
        2 * count(SubstepDemand(), speed=0.0), abs=1
    )
    inviscid = viscous_substep(spacing=0.03, density=DENSITY, viscosity=0.0, courant_number=0.3)
    assert inviscid == math.inf


def test_who_needs_too_many_substeps_is_named():
    few = SMALL.model_copy(update={"max_substeps_per_frame": 100})
    with pytest.raises(MasivError, match=r"^viscosity as strong as this .* needs 1\d\d substeps a frame, more than"):
        count(SubstepDemand(viscosity=400.0, effects=("viscosity",)), config=few)
    with pytest.raises(MasivError, match=r"^the law \(wave modulus 4e\+07 Pa\) needs"):
        count(SubstepDemand(viscosity=400.0, effects=("viscosity",)), config=few, wave_modulus=4e7)


def test_what_effects_ask_together():
    x = 0.2 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    place = [*x.mean(0).tolist(), 1e3]
    assert effects_on(x).substep_demand() == SubstepDemand()
    assert effects_on(x, viscosity=[0.0], body_force=[1.0, 0.0, 0.0]).substep_demand() == SubstepDemand()
    assert effects_on(x, stiffness_contrast=[-1.0, *place]).substep_demand() == SubstepDemand()
    # What acts later on the stress scales the viscosity before it.
    first = effects_on(x, viscosity=[30.0], stiffness_contrast=[1.0, *place]).substep_demand()
    assert (first.modulus_factor, first.viscosity) == pytest.approx((math.e, 30.0 * math.e), rel=1e-4)
    assert first.effects == ("viscosity", "stiffness_contrast")
    last = effects_on(x, stiffness_contrast=[1.0, *place], viscosity=[30.0]).substep_demand()
    assert (last.modulus_factor, last.viscosity) == pytest.approx((math.e, 30.0), rel=1e-4)
    fibres = effects_on(x, anisotropy=[1e4, 0.0, 0.0], stiffness_contrast=[1.0, *place]).substep_demand()
    assert (fibres.modulus_factor, fibres.modulus) == pytest.approx((math.e, 1e4 * math.e), rel=1e-4)
    assert count(SubstepDemand(modulus=3 * 4e4), speed=0.0) == count(SubstepDemand(modulus_factor=4.0), speed=0.0)


def test_substeps_are_halved_only_if_their_margin_is_not_enough():
    assert halved(1.0, 1.0, 0.1) == halved(1.0, 0.8, 0.1) == halved(1.0, 1 / HELD_MARGIN, 0.1) == 1.0
    assert halved(1.0, 0.7, 0.1) == halved(1.0, 0.5, 0.1) == 0.5
    assert halved(1.0, 0.49, 0.1) == 0.25
    assert halved(1.0, 0.49, 0.4) == 0.4
