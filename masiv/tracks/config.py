"""Settings of bodies with markers. Light: no torch, no taichi."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TracksConfig(BaseModel):
    """Resolution and duration of the simulation of a body with markers."""

    model_config = ConfigDict(extra="forbid")

    particles: int = Field(1700, ge=50, description="particles of the body")
    duration: float = Field(1.0, gt=0, description="how long after its release a run is fitted and evaluated [s]")
    search_duration: float = Field(
        0.1, gt=0, description="duration of the first search for a law's scale [s]; it is doubled until `duration`"
    )
    max_poissons_ratio: float = Field(
        0.45, gt=0, lt=0.5, description="upper limit of Poisson's ratio: sound that is faster costs more substeps"
    )
    rollouts: int = Field(30, ge=4, description="rollouts of each stage of a fit")
