"""Settings of the trajectory stage."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TrajectoryConfig(BaseModel):
    """Filling of the continuum and fine-tuning of its motion. Weights multiply errors measured in particle spacings."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    particle_count: int = Field(6000, ge=100, description="particles that fill the object at frame 0, about")
    fill_resolution: int = Field(72, ge=16, le=256, description="voxels along the longest side of the filled box")
    depth_tolerance: float = Field(1.5, gt=0, description="voxels in front of a rendered surface that stay filled")
    carve_tolerance: float = Field(4.0, gt=0, description="pixels outside of a mask that count against a particle")
    carve_misses: int = Field(8, ge=1, description="pictures that must rule a particle out before it is removed")
    iterations: int = Field(600, ge=0, description="steps of fine-tuning")
    learning_rate: float = Field(2e-3, gt=0, description="first step size; it falls to 2 % along a cosine")
    batch: int = Field(2048, ge=1, description="particles drawn for each step, all frames of each")
    match_every: int = Field(10, ge=1, description="steps between two nearest-neighbour searches")
    chamfer_weight: float = Field(1.0, ge=0, description="to the filled volume of each frame")
    silhouette_weight: float = Field(1.0, ge=0, description="particles outside of a mask")
    motion_weight: float = Field(0.3, ge=0, description="surface motion that the pictures gave stays")
    smoothness_weight: float = Field(0.3, ge=0, description="second differences of the motion")
    volume_weight: float = Field(1.0, ge=0, description="change of volume")
    rigidity_weight: float = Field(0.02, ge=0, description="strain; weak, since the material may flow")
    ground_weight: float = Field(10.0, ge=0, description="particles below the ground")
