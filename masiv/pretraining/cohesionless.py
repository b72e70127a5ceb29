"""A neural law trained to flow as sand does, on strains from everywhere.

One rollout shows little of a friction cone: whether matter flows depends on the ratio of two strains, over decades of
both. So strains are sampled over the lattice of the law, more of them near the cone. The plastic network learns where
the classical law flows and where it does not: where it flows, a rate of at least ``LOG_RATE_FLOWING``, at which a
substep loses everything; elsewhere at most ``LOG_RATE_RESTING``, which no observation resolves. Between them the rate
is bounded by ``table.lipschitz_envelope``: the steepest law is perfect plasticity, which a cone is.
"""

from __future__ import annotations

import math

import torch

from masiv.materials.classical import ClassicalLaw
from masiv.materials.neural import LOG_RATE_RANGE, NeuralLaw, strain_invariants
from masiv.progress import Progress

FLOW_STRAIN = 5e-4
"""Strain [1] below which the cone is rounded: less than elastic strains of sand under its weight, 1e-3 to 1e-2."""
SAMPLES, BATCH = 60_000, 4096
"""Strains in all, and in one iteration."""
MAX_LOG_STRETCH = 1.2
"""Largest logarithm of volume ratio and stretch among the samples."""
LOG_RATE_FLOWING, LOG_RATE_RESTING = 9.5, -3.0
"""Logarithms of rates [1/s]: relaxation within a tenth of a millisecond, and within 20 s."""
MIN_FLOW = 0.25
"""-ln of the kept part of a strain from which it counts as flowing; less, but not zero, is left out of the loss."""


def train(truth: ClassicalLaw, dt: float, iterations: int, seed: int, progress: Progress) -> NeuralLaw:
    """A neural law that flows where ``truth``, a law with a friction cone, does within a substep of dt [s]. Its moduli
    are those of ``truth`` at small strains, at all strains."""
    shear, bulk = _moduli(truth)
    law = NeuralLaw.of_moduli(shear_modulus=shear, bulk_modulus=bulk, seed=seed)
    with torch.no_grad():
        law.log_flow_strain.fill_(math.log(FLOW_STRAIN))
    generator = torch.Generator().manual_seed(seed)
    trial = _strains(truth, dt, generator)
    flowed = _flowed(truth, trial, dt)
    features = law.features(strain_invariants(trial), FLOW_STRAIN)
    flows, unclear = flowed > MIN_FLOW, (flowed > 0) & (flowed <= MIN_FLOW)
    optimiser = torch.optim.Adam(law.plastic.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations, eta_min=1e-5)
    for i in range(iterations):
        pick = torch.randint(len(features), (BATCH,), generator=generator)
        rate = LOG_RATE_RANGE * torch.tanh(law.plastic(features[pick]) / LOG_RATE_RANGE)
        short = torch.where(flows[pick], torch.relu(LOG_RATE_FLOWING - rate), torch.relu(rate - LOG_RATE_RESTING))
        loss = short.masked_fill(unclear[pick], 0).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if i % 100 == 99:
            progress("strains", i + 1, iterations, f"loss {float(loss.detach()):.3g}")
    return law


@torch.no_grad()
def _moduli(truth: ClassicalLaw) -> tuple[float, float]:
    """Shear and bulk modulus [Pa] at small strains."""
    small = 1e-4
    stretches = torch.tensor([[small, -small, 0.0], [small, small, small]], dtype=torch.float64).exp()
    shear, volume = truth.stress(torch.diag_embed(stretches).to(torch.float32)).double()
    return float(shear[0, 0] - shear[1, 1]) / (4 * small), float(volume.trace()) / (9 * small)


@torch.no_grad()
def _strains(truth: ClassicalLaw, dt: float, generator: torch.Generator) -> torch.Tensor:
    """Deformation gradients (SAMPLES, 3, 3): volume and shear are uniform over the law's features. In 60 % of them, the
    shear is within a factor of about two of what ``truth`` keeps under their compression."""

    def uniform() -> torch.Tensor:
        return torch.rand(SAMPLES, generator=generator)

    volume = (FLOW_STRAIN * torch.sinh(12 * uniform() - 6)).clamp(-MAX_LOG_STRETCH, MAX_LOG_STRETCH)
    shear = 0.5 * FLOW_STRAIN * torch.sqrt(torch.expm1(16 * uniform()))
    near = uniform() < 0.6
    volume = torch.where(near, -volume.abs(), volume)
    angle = 2 * math.pi * uniform()
    thirds = torch.tensor([0.0, 2.0, -2.0]) * math.pi / 3
    way = math.sqrt(2 / 3) * torch.cos(angle[:, None] + thirds)
    far = torch.diag_embed(torch.exp(way + volume[:, None] / 3))
    kept = _logs(truth.project(far, dt))[1]
    spread = torch.exp(0.6 * torch.randn(SAMPLES, generator=generator))
    shear = torch.where(near, kept * spread, shear).clamp(max=MAX_LOG_STRETCH)
    return torch.diag_embed(torch.exp(shear[:, None] * way + volume[:, None] / 3))


@torch.no_grad()
def _flowed(truth: ClassicalLaw, trial: torch.Tensor, dt: float) -> torch.Tensor:
    """-ln (K, 2) of the shares of shear and volume that ``truth`` keeps."""
    before, after = _logs(trial), _logs(truth.project(trial, dt))
    least = 1e-12
    return torch.stack(
        [
            torch.log(b.abs().clamp_min(least) / a.abs().clamp_min(least))
            for b, a in zip(before[::-1], after[::-1], strict=True)
        ],
        dim=1,
    )


def _logs(stretched: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """ln J and the size of the isochoric Hencky strain, (K,) each, of diagonal gradients (K, 3, 3)."""
    log = torch.log(stretched.diagonal(dim1=1, dim2=2))
    volume = log.sum(1)
    return volume, (log - volume[:, None] / 3).norm(dim=1)
