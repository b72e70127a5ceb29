"""Settings of the trajectory stage."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator


class TrajectoryConfig(BaseModel):
    """Filling of the continuum and fine-tuning of its motion. Weights multiply squared lengths in particle spacings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    particle_count: int = Field(6000, ge=100, description="approximate number of particles that fill the object")
    fill_resolution: int = Field(72, ge=16, le=256, description="longest side of the filled box [voxels]")
    symmetry: Literal["none", "auto"] | tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        "none",
        description="mirror plane of the body at frame 0: its normal (world axes), auto (searched for) or none; the "
        "filled hull is cut to the part whose mirror image is in the hull",
    )
    depth_tolerance: float = Field(1.0, gt=0, description="what stays filled in front of a rendered surface [voxels]")
    carve_tolerance: float = Field(
        4.0, gt=0, description="distance outside of a mask that counts against a particle [pixels]"
    )
    carve_images: int = Field(8, ge=1, description="images (view and frame) against a particle that remove it")
    iterations: int = Field(600, ge=0, description="steps of fine-tuning")
    learning_rate: float = Field(2e-3, gt=0, description="first learning rate; it falls to 2 % along a cosine")
    batch_size: int = Field(2048, ge=1, description="particles of each step, at all frames")
    match_interval: int = Field(10, ge=1, description="steps between two nearest-neighbour searches")
    chamfer_weight: float = Field(
        1.0, ge=0, description="weight of the Chamfer distance to the filled volume of each frame"
    )
    silhouette_weight: float = Field(1.0, ge=0, description="weight of the distance of particles outside of a mask")
    motion_weight: float = Field(
        0.3, ge=0, description="weight of the change of the surface motion that reconstruct found"
    )
    smoothness_weight: float = Field(0.3, ge=0, description="weight of second differences of the displacement field")
    volume_weight: float = Field(1.0, ge=0, description="weight of the change of volume")
    rigidity_weight: float = Field(0.02, ge=0, description="weight of the strain; small, since the material may flow")
    ground_weight: float = Field(10.0, ge=0, description="weight of the depth of particles below the ground")

    @field_validator("symmetry")
    @classmethod
    def _a_direction(cls, value: object) -> object:
        if isinstance(value, tuple) and not any(value):
            raise ValueError("the normal of a mirror plane must not be zero")
        return value
