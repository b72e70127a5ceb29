"""Settings of the identify stage. Light: no torch, no taichi."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from masiv.errors import InputError


class IdentifyConfig(BaseModel):
    """Initial velocity, ground and law. Lengths in metres; weights multiply mean errors in units of the object's
    size."""

    model_config = ConfigDict(extra="forbid")

    law: Literal[
        "neural", "adapter", "auto", "neo_hookean", "newtonian", "non_newtonian", "von_mises", "drucker_prager"
    ] = Field(
        "neural",
        description="what is fitted: a neural law, a small correction of a classical law, a classical law's "
        "parameters, or (auto) the classical law that explains the motion best",
    )
    also: list[str] = Field(
        [], description="run folders of other throws of the same object, from which a neural law is learnt, too"
    )
    adapter_base: Literal["auto", "neo_hookean", "newtonian", "non_newtonian", "von_mises", "drucker_prager"] = Field(
        "auto", description="the classical law that an adapter corrects; auto: the one that explains the motion best"
    )
    adapter_rank: int = Field(2, ge=1, le=4, description="shapes of strain dependence that an adapter may learn")
    family_rollouts: int = Field(45, ge=2, description="rollouts of each of the two stages of a classical law's fit")
    start: Literal["auto", "jelly", "plasticine", "sand", "water", "honey"] = Field(
        "auto",
        description="law to start from, four of them pretrained; auto: the one that is nearest to what was observed",
    )
    contact: Literal["auto", "sticky", "release", "slip"] = Field("auto", description="how the ground holds the body")
    processes: int = Field(
        0, ge=0, le=32,
        description="processes that try starting laws, and fit two, side by side; 0: one for each core that Taichi may "
        "use, four at most; on a GPU always one",
    )  # fmt: skip
    search_particles: int = Field(2000, ge=100, description="particles of the rollouts that choose the start")
    iterations: int = Field(120, ge=0, description="rollouts of the joint fit")
    samples_per_frame: int = Field(2, ge=1, le=16, description="instants per frame at which trajectories are compared")
    law_learning_rate: float = Field(4e-3, gt=0, description="step of the network weights")
    scale_learning_rate: float = Field(0.06, gt=0, description="step of the logarithms of stress and strain scale")
    velocity_learning_rate: float = Field(0.01, gt=0, description="step of velocity [m/s] and spin [rad/s]")
    ground_learning_rate: float = Field(1e-3, gt=0, description="step of the ground's height [m]")
    ground_range: float = Field(0.03, ge=0, description="the effective ground may lie this far from the scene's [m]")
    geometry_loss: Literal["trajectory", "continuum", "surface", "none"] = Field(
        "trajectory",
        description="what of the observed motion a neural law is fitted to: paths of particles, bodies frame by frame, "
        "their surfaces, or pictures alone",
    )
    polish: bool = Field(
        True,
        description="after a fit to paths, half as many iterations on surfaces, kept where the pictures are nearer",
    )
    trajectory_weight: float = Field(1.0, ge=0, description="of geometry_loss")
    silhouette_weight: float = Field(0.2, ge=0, description="of the silhouettes, while paths lead")
    polish_silhouette_weight: float = Field(1.0, ge=0, description="of the silhouettes, after the paths")
    paint_weight: float = Field(0.1, ge=0, description="of the paint that particles carry along, while paths lead")
    polish_paint_weight: float = Field(0.3, ge=0, description="of the paint, after the paths")
    prior_weight: float = Field(
        1e-2, ge=0,
        description="of the mean square by which a neural law's log moduli and log rates leave those it started with, "
        "over all strains: what the motion does not tell stays as it was",
    )  # fmt: skip
    pictures: int = Field(4, ge=0, description="pictures with which an iteration compares silhouette and paint")

    def refuse_more_throws(self) -> None:
        """Raises InputError where the law that is asked for is fitted to one throw."""
        if self.law != "neural":
            raise InputError(f"a law of kind {self.law} is fitted to one throw: leave out --also, or use --law neural")
