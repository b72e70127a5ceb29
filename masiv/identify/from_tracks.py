"""Identify the law of the bodies of a scene of tracks."""

from __future__ import annotations

from pathlib import Path

from masiv import runtime
from masiv.errors import InputError, MasivError
from masiv.identify.flights import fit_flights
from masiv.identify.tracks import conditions, fit_law, only_body, ratio_of, simulation_of
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

AUTO = ("neo_hookean", "von_mises")
"""Laws that compete if none is named."""


def group_of(tracks: Tracks) -> str | None:
    """The group in which the bodies of a scene fly; None if it is of one body. Raises InputError for several."""
    if len(tracks.bodies) == 1 and next(iter(tracks.bodies.values())).clamp is not None:
        return None
    groups = tracks.groups()
    if len(groups) == 1 and all(len(run.markers) == 1 for run in tracks.runs):
        return next(iter(groups))
    only_body(tracks)
    return None


def identify_tracks(
    tracks: Tracks, law: str, config: TracksConfig, simulator: SimulatorConfig, *,
    folder: Path | None = None, progress: Progress = silent,
) -> tuple[Twin, list[ModelFit]]:  # fmt: skip
    """The law that explains the runs of the first condition best, and the fits that competed, best first.

    law: kind of a classical law, or auto. folder: keeps rollouts, so that a killed run goes on. Raises InputError for
    any other law, MasivError if none explains the motion.
    """
    described = described_twin(tracks, config, simulator)
    group = group_of(tracks)
    with runtime.torch_threads(1):
        if group is not None:
            forward_model = PointMassModel(tracks, flight_observations(tracks, group))
            fitted = fit_flights(forward_model)
            return fitted_twin(described, fitted, forward_model, errors_mm(fitted)), [fitted]
        fits = _fit_laws(tracks, _kinds(law), config, simulator, folder, progress)
        best = fits[0]
        known = _known(tracks, config, best.model.family.kind)
        condition = conditions(tracks)[0]
        forward_model = simulation_of(tracks, condition, config, simulator, known=known, folder=folder)
        return fitted_twin(described, best, forward_model, errors_mm(best)), fits


def described_twin(tracks: Tracks, config: TracksConfig, simulator: SimulatorConfig) -> Twin:
    """What the scene says of its bodies and of how they start, without what is fitted. Raises InputError."""
    return twin_of_tracks(tracks, config, simulator, rigid=group_of(tracks) is not None)


def _fit_laws(
    tracks: Tracks, kinds: tuple[str, ...], config: TracksConfig, simulator: SimulatorConfig, folder: Path | None,
    progress: Progress,
) -> list[ModelFit]:  # fmt: skip
    """Fits of the laws that compete, best first."""
    body, condition = only_body(tracks), conditions(tracks)[0]
    fits: list[ModelFit] = []
    failed = ""
    for kind in kinds:
        known = _known(tracks, config, kind)
        forward_model = simulation_of(tracks, condition, config, simulator, known=known, folder=folder)
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
    return ratio_of(only_body(tracks), config) if has_ratio else {}


def _kinds(law: str) -> tuple[str, ...]:
    if law in ("neural", "adapter"):
        raise InputError(
            f"--law {law} needs a motion of the whole body, and a few markers do not show it: use --law auto, or one "
            f"of {', '.join(FAMILIES)}"
        )
    return AUTO if law == "auto" else (law,)


def errors_mm(fitted: ModelFit) -> dict[str, float | None]:
    """Root mean square distances of a fit, for twin.yaml."""
    return {"fit_rmse_mm": fitted.fit_mm, "held_out_rmse_mm": fitted.held_out_mm}
