"""Settings of the simulator. Light: no torch, no taichi."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SimulatorConfig(BaseModel):
    """The grid and the step follow from the object: its volume, its particle count and the speed of sound of its
    law."""

    model_config = ConfigDict(extra="forbid")

    particles_per_cell: float = Field(
        6.0, gt=0.5, le=64, description="particles in a cell of the grid: sets its spacing"
    )
    subparticles: Literal[1, 4, 8] = Field(
        4, description="particles into which each one is subdivided for a prediction, on the same grid; not for a fit"
    )
    courant_number: float = Field(
        0.3, gt=0, le=0.8, description="distance that sound and matter may cross in a substep [cells]"
    )
    max_substeps_per_frame: int = Field(
        400, ge=1, description="substeps of a frame, at most; a stiffer law is an error"
    )
    grid_nodes: int = Field(1 << 18, ge=1 << 10, description="nodes reserved for the window around the object")
    memory_mb: int = Field(1500, ge=1, description="memory for the states that the adjoint needs, at most [MB]")
    chunks: int = Field(2, ge=1, le=64, description="particle chunks that scatter apart on a CPU; part of the numbers")
