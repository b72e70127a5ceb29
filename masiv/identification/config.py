"""Settings of the identify stage. Light: no torch, no taichi."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from masiv.errors import InputError

RENAMED_STARTS = {"honey": "maxwell_fluid"}
"""Starting laws of older versions (run.yaml, twin.yaml) and their names today."""


class IdentifyConfig(BaseModel):
    """Initial velocity, ground and law. Lengths in metres; weights multiply mean errors in units of the object's
    size."""

    model_config = ConfigDict(extra="forbid")

    law: Literal[
        "neural",
        "adapter",
        "auto",
        "neo_hookean",
        "newtonian",
        "non_newtonian",
        "von_mises",
        "drucker_prager",
        "springs",
    ] = Field(
        "neural",
        description="what is fitted: a neural law, a small correction of a classical law, the parameters of a "
        "classical law, or (auto) of the classical law that explains the motion best, or of a body of springs",
    )
    also: list[str] = Field(
        [], description="run folders of other recordings of the same object; a neural law is fitted to all of them"
    )
    adapter_base: Literal["auto", "neo_hookean", "newtonian", "non_newtonian", "von_mises", "drucker_prager"] = Field(
        "auto", description="the classical law that an adapter corrects; auto: the one that explains the motion best"
    )
    adapter_rank: int = Field(
        2, ge=1, le=4, description="number of functions of strain that an adapter may add to its classical law"
    )
    family_rollouts: int = Field(45, ge=2, description="rollouts of each of the two stages of a classical law's fit")
    start: Literal["auto", "jelly", "plasticine", "sand", "water", "maxwell_fluid"] = Field(
        "auto",
        description="law that the fit of a neural law starts from: one of four pretrained laws or a Maxwell fluid; "
        "auto: the one whose rollout is nearest to the observed motion",
    )
    contact: Literal["auto", "sticky", "release", "slip"] = Field(
        "auto", description="contact condition at the ground; auto: sticky or release, whichever is nearer"
    )
    processes: int = Field(
        0, ge=0, le=32,
        description="processes that run rollouts of starting laws and fits in parallel; 0: one for each core that "
        "Taichi may use, at most four; on a GPU always one",
    )  # fmt: skip
    scheduler: str = Field(
        "", pattern=r"^$|^(tcp|tls|ucx)://\S+$",
        description="address of a Dask scheduler, as tcp://host:8786, in place of processes: starting laws and fits "
        "run there",
    )  # fmt: skip
    search_particles: int = Field(2000, ge=100, description="particles of the rollouts that choose the starting law")
    iterations: int = Field(120, ge=0, description="iterations of the joint fit, one rollout of each recording each")
    samples_per_frame: int = Field(2, ge=1, le=16, description="instants per frame at which trajectories are compared")
    law_learning_rate: float = Field(4e-3, gt=0, description="Adam step of the network weights")
    scale_learning_rate: float = Field(0.06, gt=0, description="Adam step of the logarithms of the law's scales")
    velocity_learning_rate: float = Field(0.01, gt=0, description="Adam step of velocity [m/s] and spin [rad/s]")
    ground_learning_rate: float = Field(1e-3, gt=0, description="Adam step of the ground's height [m]")
    ground_range: float = Field(
        0.03, ge=0, description="maximum distance of the effective ground from the scene's ground [m]"
    )
    geometry_loss: Literal["trajectory", "continuum", "surface", "none"] = Field(
        "trajectory",
        description="geometry loss of a neural law: distance to particle paths, Chamfer distance of the bodies at each "
        "frame, Chamfer distance of their surfaces, or none (pictures alone)",
    )
    surface_finetune: bool = Field(
        True,
        description="after the fit to paths, half as many iterations on surfaces and pictures; the result is kept if "
        "it is nearer to the pictures by more than a standard error",
    )
    trajectory_weight: float = Field(1.0, ge=0, description="weight of the geometry loss")
    silhouette_weight: float = Field(0.2, ge=0, description="weight of the silhouettes in the fit to paths")
    finetune_silhouette_weight: float = Field(
        1.0, ge=0, description="weight of the silhouettes in the surface finetune"
    )
    color_weight: float = Field(0.1, ge=0, description="weight of the particles' colors in the fit to paths")
    finetune_color_weight: float = Field(
        0.3, ge=0, description="weight of the particles' colors in the surface finetune"
    )
    prior_weight: float = Field(
        1e-2, ge=0,
        description="weight of the mean square distance of a neural law's log moduli and log rates from those of its "
        "starting law, over all strains: what the motion does not determine stays as it was",
    )  # fmt: skip
    pictures: int = Field(
        4, ge=0, description="pictures per iteration in which silhouettes and colors are compared; 0: none"
    )

    def with_surface_loss(self, iterations: int) -> IdentifyConfig:
        """The settings of a fit to surfaces and pictures that follows a fit to paths."""
        return self.model_copy(
            update={
                "geometry_loss": "surface",
                "iterations": iterations,
                "silhouette_weight": self.finetune_silhouette_weight,
                "color_weight": self.finetune_color_weight,
            }
        )

    def require_neural_for_several(self) -> None:
        """Raises InputError if the law that is asked for can only be fitted to one recording."""
        if self.law != "neural":
            raise InputError(
                f"a law of kind {self.law} is fitted to one recording: leave out --also, or use --law neural"
            )
