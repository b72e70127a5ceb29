"""Parameters of each classical law, and deformation gradients."""

from __future__ import annotations

import torch

F64 = torch.float64
EXAMPLES = {
    "neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3},
    "water": {"youngs_modulus": 1e5, "poissons_ratio": 0.3},
    "von_mises": {"youngs_modulus": 1e5, "poissons_ratio": 0.3, "yield_stress": 3e3},
    "newtonian": {"viscosity": 40.0, "bulk_modulus": 3e5},
    "non_newtonian": {"shear_modulus": 1e4, "bulk_modulus": 5e4, "yield_stress": 300.0, "plastic_viscosity": 15.0},
    "drucker_prager": {"youngs_modulus": 1e5, "poissons_ratio": 0.3, "friction_angle": 30.0},
    "springs": {"youngs_modulus": 1e5, "viscosity": 5.0},
}


def gradients(count=50, size=0.15, seed=0):
    noise = torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)
    return torch.eye(3, dtype=F64) + size * noise
