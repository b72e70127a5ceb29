"""A twin with another law, body, density or ground, from the options of ``masiv simulate``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from masiv.errors import InputError
from masiv.pipeline.stages import load_gaussians, require_run
from masiv.runfolder import RunFolder

if TYPE_CHECKING:
    import numpy as np

    from masiv.splat.gaussians import Gaussians
    from masiv.twin import Twin


def vary_twin(
    run: RunFolder,
    *,
    law: Path | None = None,
    blend: float | None = None,
    geometry: Path | None = None,
    density: float | None = None,
    ground: str | None = None,
) -> tuple[Twin, Callable[[], Gaussians]]:
    """The run's twin with another law, body, density or ground, and a function that returns the Gaussians to draw.

    Raises InputError for a run or a mesh that does not exist or cannot be used.
    """
    from masiv.materials.blend import blend as blend_laws
    from masiv.simulation import variation
    from masiv.twin import Twin

    twin = Twin.load(run.path)
    if law is not None:
        other = Twin.load(require_run(law, "--law"))
        twin = twin.with_body(law=blend_laws(twin.law, other.law, 1.0 if blend is None else blend))
    if density is not None:
        twin = variation.with_density(twin, density)
    if geometry is None:
        return _with_ground(twin, ground), lambda: load_gaussians(run).at(0.0)
    if geometry.is_dir():
        source = RunFolder.open(require_run(geometry, "--geometry"))
        twin, shift = variation.with_body_of(twin, Twin.load(source.path))
        return _with_ground(twin, ground), lambda: _shifted(load_gaussians(source).at(0.0), shift)
    if not geometry.is_file():
        raise InputError(f"--geometry {geometry} does not exist: give a mesh file or another run's folder")
    twin = variation.with_mesh(twin, geometry)

    def gaussians() -> Gaussians:
        from masiv.report.film import balls

        return balls(twin.positions, twin.volume)

    return _with_ground(twin, ground), gaussians


def _with_ground(twin: Twin, ground: str | None) -> Twin:
    from masiv.simulation.variation import with_ground

    return twin if ground is None else with_ground(twin, ground)


def _shifted(gaussians: Gaussians, shift: np.ndarray) -> Gaussians:
    import torch

    return replace(gaussians, means=gaussians.means + torch.as_tensor(shift).to(gaussians.means))
