"""Settings of the reconstruct stage."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class ReconstructConfig(BaseModel):
    """Dynamic Gaussians from video. Lengths of steps are shares of the object's half-extent."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processes: int = Field(
        0, ge=0, le=2,
        description="processes that share the pictures of a step; 0: two where Taichi may use two cores or more; on a "
        "GPU always one",
    )  # fmt: skip
    gaussians: int = Field(5000, ge=50, description="Gaussians on the surface of the first frame's hull, at most")
    hull_resolution: int = Field(64, ge=8, le=256, description="voxels along the longest side of a hull")
    crop_side: int = Field(
        128, ge=16, description="pictures are averaged down until the object's box is at most this wide"
    )
    crop_padding: int = Field(8, ge=1, description="pixels around the object's box")

    bases: int = Field(10, ge=1, description="motion bases B")
    width: int = Field(96, ge=4, description="hidden width of the motion networks")
    depth: int = Field(3, ge=1, description="hidden layers of the motion networks")
    space_octaves: int = Field(3, ge=0, description="octaves of the encoding of a position")
    time_octaves: int = Field(6, ge=0, description="octaves of the encoding of time, at most; few frames allow fewer")

    iterations: int = Field(9000, ge=1, description="steps, each on a few pictures")
    pictures: int = Field(3, ge=1, description="pictures a step; the first shows the newest frame while frames come in")
    first_frame_share: float = Field(0.12, ge=0, le=0.5, description="share of the steps on frame 0 alone")
    growth_share: float = Field(0.5, ge=0, le=0.9, description="share of the steps in which the other frames come in")

    means_rate: float = Field(2e-3, gt=0, description="step of positions at first")
    motion_rate: float = Field(5e-3, gt=0, description="step of the networks' weights at first")
    base_rate: float = Field(3e-3, gt=0, description="step of the base motion at first")
    scale_rate: float = Field(1e-2, gt=0, description="step of log sizes at first")
    opacity_rate: float = Field(3e-2, gt=0, description="step of opacity logits at first")
    colour_rate: float = Field(2e-2, gt=0, description="step of colour logits at first")
    followed_rate: float = Field(
        5e-3, gt=0, le=1,
        description="share of means_rate left once frame 0 is fitted, and of colour_rate while frames come in",
    )  # fmt: skip
    final_rate: float = Field(0.05, gt=0, le=1, description="share of a step that is left at the end")

    ssim_weight: float = Field(0.2, ge=0, le=1, description="of 1 - SSIM; the rest is L1")
    alpha_weight: float = Field(0.5, ge=0, description="of alpha against the mask")
    scale_weight: float = Field(0.002, ge=0, description="of the mean size over its first value")
    rigidity_weight: float = Field(0.3, ge=0, description="of squared strain between neighbours")
    hull_weight: float = Field(0.3, ge=0, description="of the distance to a frame's hull; fades out by the end")
    ground_weight: float = Field(1.0, ge=0, description="of the depth below the ground")
    neighbours: int = Field(8, ge=1, description="neighbours a Gaussian in the rigidity term")
    prune_opacity: float = Field(0.02, ge=0, lt=1, description="Gaussians below it are removed")
