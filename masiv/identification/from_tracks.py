"""Identify the law of the bodies of a scene of tracks."""

from __future__ import annotations

from pathlib import Path

from masiv import runtime
from masiv.errors import InputError, MasivError
from masiv.identification.flights import fit_flights
from masiv.identification.tracks import clamped_body_model, conditions, declared_poissons_ratio, fit_law, single_body
from masiv.inference.model_fit import ModelFit, rank_by_bic
from masiv.models.families import FAMILIES, family_of
from masiv.models.point_mass import PointMassModel
from masiv.mpm.config import SimulatorConfig
from masiv.observations.tracks import flight_observations
from masiv.progress import Progress, silent
from masiv.simulation.fitted_twin import fitted_twin
from masiv.tracks.config import TracksConfig
from masiv.tracks.tracks import Tracks
from masiv.twin import Twin
from masiv.twin.from_tracks import twin_of_tracks

AUTO_FAMILIES = ("neo_hookean", "von_mises")
"""Law families that are fitted if none is named."""


def flight_group(tracks: Tracks) -> str | None:
    """The group of the bodies of a scene in free flight; None for one body. Raises InputError for several groups."""
    if len(tracks.bodies) == 1 and next(iter(tracks.bodies.values())).clamps:
        return None
    groups = tracks.groups()
    if len(groups) == 1 and all(len(run.markers) == 1 for run in tracks.runs):
        return next(iter(groups))
    single_body(tracks)
    return None


def identify_tracks(
    tracks: Tracks,
    law: str,
    config: TracksConfig,
    simulator: SimulatorConfig,
    *,
    folder: Path | None = None,
    progress: Progress = silent,
) -> tuple[Twin, list[ModelFit]]:
    """The twin with the law that explains the runs of the first condition best, and all fits, best first.

    law: a law family, or auto. folder: keeps rollouts, so that a killed run goes on. Raises InputError for a neural law
    or an adapter, MasivError if no law explains the motion.
    """
    described = described_twin(tracks, config, simulator)
    group = flight_group(tracks)
    with runtime.torch_threads(1):
        if group is not None:
            forward_model = PointMassModel(tracks, flight_observations(tracks, group))
            fitted = fit_flights(forward_model)
            return fitted_twin(described, fitted, forward_model, errors_mm(fitted)), [fitted]
        fits = _fit_laws(tracks, law, config, simulator, folder, progress)
        best = fits[0]
        known = _known(tracks, config, best.model.family.kind)
        forward_model = clamped_body_model(tracks, conditions(tracks)[0], config, simulator, known=known, folder=folder)
        return fitted_twin(described, best, forward_model, errors_mm(best)), fits


def described_twin(tracks: Tracks, config: TracksConfig, simulator: SimulatorConfig) -> Twin:
    """The bodies of a scene and their initial states as it declares them, before any fit. Raises InputError."""
    return twin_of_tracks(tracks, config, simulator, rigid=flight_group(tracks) is not None)


def _fit_laws(
    tracks: Tracks,
    law: str,
    config: TracksConfig,
    simulator: SimulatorConfig,
    folder: Path | None,
    progress: Progress,
) -> list[ModelFit]:
    """Fits of the families of ``law``, best first. Raises MasivError if none explains the motion."""
    body, condition = single_body(tracks), conditions(tracks)[0]
    fits: list[ModelFit] = []
    failed = ""
    for kind in _kinds(law):
        known = _known(tracks, config, kind)
        forward_model = clamped_body_model(tracks, condition, config, simulator, known=known, folder=folder)
        family = family_of(kind, body.density or 1e3, known)
        try:
            fits.append(fit_law(forward_model, family, config, progress))
        except MasivError as error:
            failed = str(error)
            progress(f"identify: {kind}", 1, 1, failed)
    if not fits:
        raise MasivError(f"identify: no classical law explains the motion: {failed}")
    return rank_by_bic(fits)


def _known(tracks: Tracks, config: TracksConfig, kind: str) -> dict[str, float]:
    """Poisson's ratio as the scene declares it, if the law ``kind`` has one."""
    has_ratio = "poissons_ratio" in {p.name for p in FAMILIES[kind].parameters}
    return declared_poissons_ratio(single_body(tracks), config) if has_ratio else {}


def _kinds(law: str) -> tuple[str, ...]:
    if law in ("neural", "adapter"):
        raise InputError(
            f"--law {law} needs the motion of the whole body, which a few markers do not show: use --law auto, or one "
            f"of {', '.join(FAMILIES)}"
        )
    return AUTO_FAMILIES if law == "auto" else (law,)


def errors_mm(fitted: ModelFit) -> dict[str, float | None]:
    """Root mean square distances of a fit [mm], as twin.yaml holds them."""
    return {"fit_rmse_mm": fitted.fit_mm, "validation_rmse_mm": fitted.validation_mm}
