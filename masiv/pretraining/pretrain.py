"""Initial laws: a neural law trained on the full state of one simulated rollout of a classical material (as in NCLaw).

Two phases. First the pointwise states of the rollout (trial gradient, elastic gradient, stress) are fitted. Then the
law is rolled out from true states, in segments that grow, and the positions are compared (teacher forcing, Ma et al.
2023, section 4). Sand is trained in another way: see ``cohesionless``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import torch

from masiv.errors import InputError
from masiv.materials.classical import ClassicalLaw
from masiv.materials.neural import NeuralLaw, strain_invariants
from masiv.mpm.rollout import at_rest, rollout
from masiv.mpm.simulator import Simulator
from masiv.mpm.state import State
from masiv.pretraining import cohesionless
from masiv.progress import Progress, silent

MATERIALS = {
    "jelly": ("neo_hookean", {"youngs_modulus": 1e5, "poissons_ratio": 0.2}),
    "plasticine": ("von_mises", {"youngs_modulus": 3e5, "poissons_ratio": 0.25, "yield_stress": 5e3}),
    "sand": ("drucker_prager", {"youngs_modulus": 1e6, "poissons_ratio": 0.2, "friction_angle": 25.0}),
    "water": ("water", {"youngs_modulus": 1e5, "poissons_ratio": 0.3}),
}
"""Classical law of each material, with the parameters of NCLaw's rollouts; jelly is neo-Hookean here."""
SIDE, PER_SIDE = 0.5, 10
"""Side of the cube [m], and particles along it."""
STEPS, DT = 1000, 5e-4
"""Substeps of the rollout, each of DT [s]."""
VELOCITY, OMEGA = (1.0, -1.5, -2.0), (4.0, 4.0, 4.0)
"""Of the cube at the start [m/s], [rad/s]."""
MODULUS_WEIGHT = 1e-3


def pretrained_path(material: str) -> Path:
    """The shipped law of ``material``. Raises InputError for an unknown name or a missing file."""
    if material not in MATERIALS:
        raise InputError(f"unknown material '{material}': use one of {', '.join(MATERIALS)}")
    path = Path(str(files("masiv.assets"))) / "laws" / f"{material}.safetensors"
    if not path.is_file():
        raise InputError(f"{path} is missing: run masiv pretrain {material} --out {path.parent}")
    return path


@dataclass(frozen=True)
class TrainingRollout:
    """States[k] of a simulated body before substep k, and what the true law made of each."""

    states: list[State]
    gradients: torch.Tensor  # (K, N, 3, 3) after the return mapping
    stresses: torch.Tensor  # (K, N, 3, 3) [Pa]


def simulator(count: int = PER_SIDE**3) -> Simulator:
    return Simulator(
        particle_count=count, spacing=1 / 20, substep=DT, volume=SIDE**3, density=1e3, gravity=(0.0, -9.8, 0.0),
        contact="slip", max_substeps=STEPS, grid_nodes=1 << 18,
    )  # fmt: skip


def training_rollout(material: str) -> TrainingRollout:
    """A cube of ``material`` that falls, spinning, onto a frictionless floor."""
    kind, parameters = MATERIALS[material]
    law = ClassicalLaw(kind, **parameters)
    axis = (torch.arange(PER_SIDE) + 0.5) / PER_SIDE * SIDE
    position = torch.cartesian_prod(axis, axis + 0.25, axis)
    spin = torch.linalg.cross(torch.tensor(OMEGA).expand_as(position), position - position.mean(0))
    wx, wy, wz = OMEGA
    skew = torch.tensor([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]])
    initial = at_rest(position, torch.tensor(VELOCITY) + spin, skew.expand(len(position), 3, 3))
    sim = simulator()
    recording = sim.run(initial, law, STEPS, [0])
    states = [recording.read(s) for s in range(STEPS + 1)]
    trials = torch.stack([s.trial_gradient for s in states]).double()
    gradients = torch.stack([law.project(f, DT) for f in trials])
    stresses = torch.stack([law.stress(f) for f in gradients])
    return TrainingRollout(states, gradients.float().detach(), stresses.float().detach())


def pretrain(
    material: str, *, seed: int = 0, pointwise: int = 6000, epochs: int = 8, progress: Progress = silent
) -> tuple[NeuralLaw, dict[str, float]]:
    """A neural law that behaves like ``material``, and how well.

    Returns the law and {"stress_error": relative RMS, "gradient_error": RMS of F over what the flow changes,
    "position_error_mm": mean error of a 200-substep rollout from true states}. Raises InputError for an unknown
    material.
    """
    if material not in MATERIALS:
        raise InputError(f"unknown material '{material}': use one of {', '.join(MATERIALS)}")
    kind, parameters = MATERIALS[material]
    truth = training_rollout(material)
    if kind == "drucker_prager":
        law = cohesionless.train(ClassicalLaw(kind, **parameters), DT, pointwise // 2, seed, progress)
        return law, _quality(law, truth)
    law = NeuralLaw(stress_scale=ClassicalLaw(kind, **parameters).wave_modulus() / 2, seed=seed)
    strain = strain_invariants(torch.cat([state.trial_gradient for state in truth.states[::10]]))
    with torch.no_grad():
        law.log_flow_strain.copy_(0.5 * torch.log(strain[:, 1:].sum(1).mean() / 4))
    _fit_pointwise(law, truth, pointwise, seed, progress)
    _fit_rollouts(law, truth, epochs, progress)
    return law, _quality(law, truth)


def _fit_pointwise(law: NeuralLaw, truth: TrainingRollout, iterations: int, seed: int, progress: Progress) -> None:
    trial = torch.stack([s.trial_gradient for s in truth.states])
    flowed = (truth.gradients @ truth.gradients.mT - trial @ trial.mT).pow(2).mean().sqrt().clamp_min(1e-5)
    stress_scale = truth.stresses.pow(2).mean().sqrt()
    optimiser = torch.optim.Adam(law.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, eta_min=1e-5)
    flat = trial.flatten(0, 1), truth.gradients.flatten(0, 1), truth.stresses.flatten(0, 1)
    for i in range(iterations):
        pick = torch.randint(len(flat[0]), (2048,), generator=torch.Generator().manual_seed(seed * 1_000_003 + i))
        f_trial, f, tau = (a[pick] for a in flat)
        out = law.project(f_trial, DT)
        stress_error = _mean_norm(((law.stress(f) - tau) / stress_scale).flatten(1))
        flow_error = _mean_norm(((out @ out.mT - f @ f.mT) / flowed).flatten(1))
        # A modulus of strain that flows at once cannot be learnt: keep it small, since it would set the substep.
        shear = (law.moduli(strain_invariants(f))[:, :2] / law.log_stress_scale.detach().exp()).mean()
        loss = stress_error + flow_error + MODULUS_WEIGHT * shear
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if i % 100 == 99:
            progress("pointwise", i + 1, iterations, f"loss {float(loss.detach()):.3g}")


def _mean_norm(error: torch.Tensor) -> torch.Tensor:
    """Mean norm of (N, K): robust, since near a yield surface the square error is all in a few particles."""
    return (error.pow(2).sum(1) + 1e-6).sqrt().mean()


def _fit_rollouts(law: NeuralLaw, truth: TrainingRollout, epochs: int, progress: Progress) -> None:
    sim = simulator()
    optimiser = torch.optim.Adam(law.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(epochs, 1), eta_min=1e-5)
    for epoch in range(epochs):
        # The segments grow from 25 to 200 substeps along a cosine, as in NCLaw.
        length = round(200 - 175 * 0.5 * (1 + math.cos(math.pi * epoch / epochs)))
        optimiser.zero_grad()
        total = 0.0
        starts = range(0, STEPS - length + 1, length)
        for start in starts:
            loss = _segment_loss(law, sim, truth, start, length) / len(starts)
            loss.backward()
            total += float(loss.detach())
        torch.nn.utils.clip_grad_norm_(law.parameters(), 0.1, error_if_nonfinite=True)
        optimiser.step()
        schedule.step()
        progress("rollouts", epoch + 1, epochs, f"mean error {1e3 * total:.2f} mm over {length} substeps")


def _segment_loss(law: NeuralLaw, sim: Simulator, truth: TrainingRollout, start: int, length: int) -> torch.Tensor:
    outputs = list(range(5, length + 1, 5))
    motion = rollout(sim, law, truth.states[start], length, outputs)
    target = torch.stack([truth.states[start + k].position for k in outputs])
    return (motion - target).norm(dim=2).mean()


@torch.no_grad()
def _quality(law: NeuralLaw, truth: TrainingRollout) -> dict[str, float]:
    trial = torch.stack([s.trial_gradient for s in truth.states]).flatten(0, 1)
    gradients, stresses = truth.gradients.flatten(0, 1), truth.stresses.flatten(0, 1)
    out = law.project(trial, DT)
    changed = (gradients @ gradients.mT - trial @ trial.mT).pow(2).mean().sqrt().clamp_min(1e-5)
    sim = simulator()
    errors = [float(_segment_loss(law, sim, truth, start, 200)) for start in range(0, STEPS, 200)]
    return {
        "stress_error": float((law.stress(gradients) - stresses).pow(2).mean().sqrt() / stresses.pow(2).mean().sqrt()),
        "gradient_error": float((out @ out.mT - gradients @ gradients.mT).pow(2).mean().sqrt() / changed),
        "position_error_mm": 1e3 * sum(errors) / len(errors),
    }
