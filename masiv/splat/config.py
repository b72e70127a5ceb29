"""Settings of the reconstruct stage."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from masiv.calibration.config import CalibrationPrior


class CalibrationConfig(CalibrationPrior):
    """Prior standard deviations of the corrections of cameras and exposures, and the optimiser's steps."""

    log_gain: float = Field(
        0.05, gt=0, description="prior standard deviation of the logarithm of an image's gain, for each colour channel"
    )
    offset: float = Field(
        0.01, gt=0, description="prior standard deviation of an image's offset, as a fraction of white"
    )
    rate_px: float = Field(0.01, gt=0, description="initial learning rate of cameras [pixels]")
    exposure_rate: float = Field(0.02, gt=0, description="initial learning rate of exposures [steps of 2 % of white]")
    start_fraction: float = Field(
        0.06, ge=0, lt=1, description="fraction of the steps after which cameras are refined; before, the first frame "
        "settles",
    )  # fmt: skip


class ReconstructConfig(BaseModel):
    """Dynamic Gaussians from video. Learning rates of positions are fractions of the object's half-extent."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processes: int = Field(
        0, ge=0, le=2,
        description="processes that compute the gradient of a step; 0: two if Taichi may use two cores or more; one "
        "on a GPU",
    )  # fmt: skip
    gaussians: int = Field(5000, ge=50, description="Gaussians on the surface of the first frame's hull, at most")
    hull_resolution: int = Field(64, ge=8, le=256, description="longest side of a hull [voxels]")
    crop_side: int = Field(
        128, ge=16, description="images are averaged down until the object's box is at most this wide [pixels]"
    )
    crop_padding: int = Field(8, ge=1, description="margin around the object's box [pixels]")

    refine_calibration: bool = Field(
        True, description="whether cameras and exposures are refined with the Gaussians; false: the calibration is kept"
    )
    calibration: CalibrationConfig = CalibrationConfig.model_validate({})

    bases: int = Field(10, ge=1, description="motion bases B")
    width: int = Field(96, ge=4, description="hidden width of the motion networks")
    depth: int = Field(3, ge=1, description="hidden layers of the motion networks")
    space_octaves: int = Field(3, ge=0, description="octaves of the positional encoding of space")
    time_octaves: int = Field(6, ge=0, description="octaves of the positional encoding of time, at most; fewer if "
                              "there are few frames")  # fmt: skip

    iterations: int = Field(9000, ge=1, description="steps, each on a batch of images")
    batch_size: int = Field(3, ge=1, description="images of a step; the first shows the newest frame while frames are "
                            "added")  # fmt: skip
    first_frame_fraction: float = Field(0.12, ge=0, le=0.5, description="fraction of the steps on frame 0 alone")
    growth_fraction: float = Field(0.5, ge=0, le=0.9, description="fraction of the steps in which frames are added")

    means_rate: float = Field(
        2e-3, gt=0, description="initial learning rate of positions, as a fraction of the object's half-extent"
    )
    motion_rate: float = Field(5e-3, gt=0, description="initial learning rate of the networks' weights")
    base_rate: float = Field(3e-3, gt=0, description="initial learning rate of the base motion")
    scale_rate: float = Field(1e-2, gt=0, description="initial learning rate of log scales")
    opacity_rate: float = Field(3e-2, gt=0, description="initial learning rate of opacity logits")
    colour_rate: float = Field(2e-2, gt=0, description="initial learning rate of colour logits")
    canonical_rate_factor: float = Field(
        5e-3, gt=0, le=1,
        description="factor of means_rate after the first frame is fitted, and of colour_rate while frames are added",
    )  # fmt: skip
    final_rate_factor: float = Field(0.05, gt=0, le=1, description="factor of all learning rates at the end")

    ssim_weight: float = Field(
        0.2, ge=0, le=1, description="weight of 1 - SSIM; that of the L1 distance is one minus it"
    )
    alpha_weight: float = Field(0.5, ge=0, description="weight of the difference between alpha and mask")
    depth_weight: float = Field(
        0.3,
        ge=0,
        description="weight of the rendered depth's distance to the measured one, over the object's half-extent",
    )
    cloud_weight: float = Field(
        1.0, ge=0, description="weight of the distance to a frame's point cloud, over the object's half-extent"
    )
    scale_weight: float = Field(0.002, ge=0, description="weight of the mean scale over its initial value")
    rigidity_weight: float = Field(0.3, ge=0, description="weight of the squared strain between neighbours")
    hull_weight: float = Field(0.3, ge=0, description="weight of the distance to a frame's hull; it decays to zero")
    ground_weight: float = Field(1.0, ge=0, description="weight of the depth below the ground")
    neighbours: int = Field(8, ge=1, description="neighbours of a Gaussian in the rigidity term")
    prune_opacity: float = Field(0.02, ge=0, lt=1, description="Gaussians with a lower opacity are removed")
