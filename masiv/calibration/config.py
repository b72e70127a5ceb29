"""What is believed of given cameras before any picture is seen."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class CalibrationPrior(BaseModel):
    """Prior standard deviations of the corrections of cameras."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rotation_deg: float = Field(0.3, gt=0, description="prior standard deviation of a camera's rotation [degrees]")
    translation_fraction: float = Field(
        0.003,
        gt=0,
        description="prior standard deviation of a camera's place, as a fraction of its distance to the object",
    )
    focal_fraction: float = Field(
        0.005, gt=0, description="prior standard deviation of a camera's focal length, as a fraction of it"
    )
    time_frames: float = Field(
        0.3,
        gt=0,
        description="prior standard deviation of a camera's clock [frames]; 0.3 is that of cameras aligned to "
        "the nearest frame",
    )
