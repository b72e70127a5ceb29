"""Settings of refine. Light: no torch, no taichi."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RefineConfig(BaseModel):
    """How hard to look for missing effects, and what is enough to accept one."""

    model_config = ConfigDict(extra="forbid")

    processes: int = Field(
        0, ge=0, le=32,
        description="processes that fit causes side by side; 0: one for each core that Taichi may use, four at most; "
        "on a GPU always one",
    )  # fmt: skip
    particles: int = Field(1500, ge=100, description="particles of the rollouts")
    search_particles: int = Field(500, ge=100, description="particles of the short fits that choose the laws")
    samples_per_frame: int = Field(
        1, ge=1, le=16, description="instants per frame at which motions are compared; only whole frames are observed"
    )
    families: int = Field(2, ge=1, description="classical laws that compete, the best by their fit without any effect")
    laws: list[str] = Field([], description="families that compete; all where empty")
    effects: list[str] = Field([], description="effects that are considered; the whole library where empty")
    baseline_rollouts: int = Field(45, ge=2, description="rollouts of each stage of a law's fit without effects")
    shortlist: int = Field(4, ge=1, description="effects that are fitted through the rollout, after the ranking")
    max_effects: int = Field(3, ge=1, description="effects that may be added")
    above_noise: float = Field(
        1.2, ge=0,
        description="residual over the noise below which nothing is looked for, if held-out frames are foretold to "
        "``unexplained`` times what noise and grid explain",
    )  # fmt: skip
    tracking_error: float = Field(
        0.4, ge=0, le=1,
        description="how far points that are followed in pictures are off, over how far they left a rigid motion",
    )  # fmt: skip
    unexplained: float = Field(
        1.75, ge=1,
        description="residual, over what noise and grid explain, from which something is missing: a further effect is "
        "looked for, and where none is found, it is called unexplained",
    )  # fmt: skip
    search_second_effect: bool = Field(
        True, description="with a cause found and less than ``unexplained`` left, look for one of one number beside it"
    )
    least_explained: float = Field(0.1, ge=0, le=1, description="share of the residual below which none is tried")
    least_gain: float = Field(
        0.15, ge=0, le=1,
        description="share of the held-out error that an effect must remove where it explains more of the fitted "
        "motion than noise and grid could change",
    )  # fmt: skip
    decisive_gain: float = Field(0.5, ge=0, le=1, description="the same where it explains next to nothing of that")
    simple_gain: float = Field(
        0.25, ge=0, le=1, description="the same for an effect that is one number, where the criterion is clear"
    )
    decisive: float = Field(
        4.0, ge=1,
        description="variance that an effect must explain, over the noise's, in the phase where the simulation is as "
        "certain as the observation, to be accepted although held-out frames confirm little and contradict nothing",
    )  # fmt: skip
    plain_sigmas: float = Field(
        6.0, ge=0,
        description="sigmas, of a noise as smooth as what is left, from which the noise's own variance is enough there",
    )  # fmt: skip
    least_bic: float = Field(
        6.0, ge=0,
        description="how far an effect must lower the information criterion, to which held-out frames are one sample "
        "more; from 6 on evidence is called strong (Kass and Raftery, JASA 90, 1995)",
    )  # fmt: skip
    clear_bic: float = Field(
        20.0, ge=0,
        description="from where the criterion is so clear that held-out frames need to confirm less: of an effect that "
        "is one number, and of a second one",
    )  # fmt: skip
    least_sigmas: float = Field(3.0, ge=0, description="standard errors that a strength must lie from zero")
    least_apart: float = Field(
        2.0, ge=0, description="sigmas of smooth noise from which one cause is told from another that explains less"
    )
    confusable: float = Field(0.95, gt=0, le=1, description="correlation from which two effects look alike")
