"""Writes results of every kernel on one arch: run by test_arch.py in processes of their own.

    python tests/arch_results.py ARCH FILE.npz [GROUP ...]

Groups: laws (a rollout with each law), gradients (of rollouts with each contact), effects (all of them, a rollout and
its gradients if it has any), picture. Float32; a number has the same meaning on every arch.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from effect_cases import STEPS, body, setting, simulator
from law_examples import EXAMPLES
from random_gaussians import BACKGROUND, make_camera, make_gaussians, weighted

from masiv import runtime
from masiv.effects.active import ActiveEffects
from masiv.effects.catalogue import effects
from masiv.effects.effect import ContactEffect, SuspendedMassEffect
from masiv.materials.classical import ClassicalLaw
from masiv.materials.neural import NeuralLaw
from masiv.models.initial_state import rigid_initial_state
from masiv.mpm.rollout import rollout
from masiv.splat.rasteriser import render

F32 = torch.float32
Results = dict[str, torch.Tensor]


def elastic():
    return ClassicalLaw("neo_hookean", youngs_modulus=2e4, poissons_ratio=0.3)


def thrown(law, contact, active=None):
    """End of a throw onto the ground, and its gradients by velocity, spin, the law's parameters and the effects'."""
    x = body().to(F32)
    launch = [torch.tensor(v, requires_grad=True) for v in ([0.6, -1.2, 0.3], [2.0, 1.0, -3.0])]
    sim = simulator(len(x), contact, dtype=F32)
    end = rollout(sim, law, rigid_initial_state(x, *launch), STEPS, [STEPS], active)[0]
    weights = torch.rand(len(x), 3, generator=torch.Generator().manual_seed(2))
    thetas = [] if active is None else [theta for _, theta in active.members]
    leaves = [*launch, *law.parameters(), *thetas]
    bars = torch.autograd.grad((weights * end).sum(), leaves, allow_unused=True)
    flat = [torch.zeros(0) if bar is None else bar.to(F32).flatten() for bar in bars]
    return end.detach(), torch.cat(flat[:2]), torch.cat(flat[2:])


def of_laws() -> Results:
    x = body().to(F32)
    out = {}
    for name, parameters in EXAMPLES.items():
        start = rigid_initial_state(x, torch.tensor([0.6, -1.2, 0.3]), torch.tensor([2.0, 1.0, -3.0]))
        sim = simulator(len(x), dtype=F32)
        out[name] = sim.run(start, ClassicalLaw(name, **parameters), STEPS, [STEPS]).positions[0]
    return out


def of_gradients() -> Results:
    out = {}
    for name, law in (("neo_hookean", elastic()), ("neural", NeuralLaw(stress_scale=5e3, seed=3))):
        for contact in ("sticky", "release", "slip"):
            parts = thrown(law, contact)
            out |= {f"{name} {contact} {part}": x for part, x in zip(("end", "start", "law"), parts, strict=True)}
    return out


def present(effect):
    """Values at which the effect does something: two steps of each strength, other parameters as they start."""
    values = [(2 + i) * p.step if i < effect.strengths else p.start for i, p in enumerate(effect.parameters)]
    return torch.tensor(values, requires_grad=True)


def of_effects() -> Results:
    x = body().to(F32)
    library, out = effects(), {}
    on_ground = [name for name, e in library.items() if isinstance(e, ContactEffect)]
    # A rollout with a suspended mass has no gradient.
    hanging = [name for name, e in library.items() if isinstance(e, SuspendedMassEffect)]
    anywhere = [name for name in library if name not in on_ground + hanging]
    for name in on_ground:  # one contact may act at a time
        members = tuple((library[n], present(library[n])) for n in (*anywhere, name))
        parts = thrown(elastic(), "slip", ActiveEffects(members, setting(x)))
        out |= {f"all effects, {name} {part}": v for part, v in zip(("end", "start", "values"), parts, strict=True)}
    for name in hanging:
        sim = simulator(len(x), dtype=F32)
        active = ActiveEffects(((library[name], present(library[name])),), setting(x))
        start = rigid_initial_state(x, torch.tensor([0.6, -1.2, 0.3]), torch.tensor([2.0, 1.0, -3.0]))
        taken = sim.run(start, elastic(), STEPS, [STEPS], active)
        out[name] = torch.cat([taken.positions[0], taken.final.suspended])
    return out


def of_picture() -> Results:
    gaussians = make_gaussians(300, seed=9, dtype=F32)
    picture = render(make_camera(80, 70), *gaussians, BACKGROUND.to(F32))
    bars = torch.autograd.grad(weighted(picture), gaussians)
    names = ("by means", "by scales", "by opacities", "by colours")
    return {"picture": picture.rgb.detach(), "depth": picture.depth.detach()} | dict(zip(names, bars, strict=True))


GROUPS = {"laws": of_laws, "gradients": of_gradients, "effects": of_effects, "picture": of_picture}

if __name__ == "__main__":
    arch, file, *groups = sys.argv[1:]
    runtime.start(arch)
    found: Results = {}
    for group in groups or GROUPS:
        found |= GROUPS[group]()
    np.savez(file, **{name: value.numpy() for name, value in found.items()})
