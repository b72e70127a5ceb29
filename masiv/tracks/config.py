"""Settings of bodies with markers. Light: no torch, no taichi."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TracksConfig(BaseModel):
    """How finely and for how long a body with markers is simulated."""

    model_config = ConfigDict(extra="forbid")

    particles: int = Field(1700, ge=50, description="particles of the body")
    duration: float = Field(1.0, gt=0, description="how long after its release a run is fitted and judged [s]")
    search_duration: float = Field(
        0.1, gt=0, description="how long of it the first search for a law's scale looks at [s]; then twice that, and on"
    )
    highest_poissons_ratio: float = Field(
        0.45, gt=0, lt=0.5, description="a body that is declared less compressible has this: sound costs substeps"
    )
    rollouts: int = Field(30, ge=4, description="rollouts of each stage of a fit")
