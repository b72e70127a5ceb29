"""Settings of the pass that follows frames which a finished reconstruction has not seen."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class FollowConfig(BaseModel):
    """How new frames are followed; pictures and their weights are as in ``reconstruct``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    effort: float = Field(0.45, gt=0, description="steps a new frame, as a share of reconstruct's steps a frame")
    growth_share: float = Field(0.65, ge=0, lt=1, description="share of the steps in which the new frames come in")
    relearn_steps: int = Field(600, ge=1, description="steps, without pictures, that learn the known motion again")
    relearn_points: int = Field(500, ge=1, description="Gaussians that one of them, or of the rehearsal, looks at")
    relearn_rate: float = Field(5e-3, gt=0, description="step of the networks' weights at first while they relearn")
    rate_share: float = Field(0.5, gt=0, le=1, description="share of reconstruct's steps of motion and base motion")
    rehearsal_weight: float = Field(300.0, ge=0, description="of the squared change of the known motion")
    rehearsal_frames: int = Field(4, ge=1, description="known frames that one step rehearses")
