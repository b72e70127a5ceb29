"""Settings of refine. Light: no torch, no taichi."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

RENAMED_KEYS = {
    "above_noise": "noise_threshold",
    "unexplained": "max_reduced_chi",
    "least_explained": "min_explained",
    "least_gain": "min_gain",
    "simple_gain": "single_parameter_gain",
    "decisive": "decisive_variance_ratio",
    "plain_sigmas": "min_gls_z",
    "least_bic": "min_bic_gain",
    "clear_bic": "clear_bic_gain",
    "least_sigmas": "min_strength_z",
    "least_apart": "min_vuong_z",
    "confusable": "confusable_correlation",
    "second_look": "search_second_effect",
}
"""Keys of earlier versions: old name -> new name."""


class RefineConfig(BaseModel):
    """How hard to look for missing effects, and what is enough to accept one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processes: int = Field(
        0, ge=0, le=32,
        description="processes that fit effects in parallel; 0: one for each core that Taichi may use, four at most; "
        "on a GPU always one",
    )  # fmt: skip
    particles: int = Field(1500, ge=100, description="particles of the rollouts; of tracks: tracks.particles")
    search_particles: int = Field(500, ge=100, description="particles of the short fits that choose the laws")
    samples_per_frame: int = Field(
        1, ge=1, le=16, description="instants per frame at which motions are compared; only whole frames are observed"
    )
    families: int = Field(2, ge=1, description="classical laws that compete, the best by their fit without any effect")
    laws: list[str] = Field([], description="families that compete; all if empty")
    effects: list[str] = Field([], description="effects that are considered; the whole library if empty")
    baseline_rollouts: int = Field(45, ge=2, description="rollouts of each stage of a law's fit without effects")
    shortlist: int = Field(4, ge=1, description="effects that are fitted through the rollout, after the ranking")
    max_effects: int = Field(3, ge=1, description="effects that may be added")
    noise_threshold: float = Field(
        1.2, ge=0,
        description="residual over the noise of the observation below which nothing is looked for, if the reduced chi "
        "of the held-out instants is below max_reduced_chi",
    )  # fmt: skip
    tracking_error: float = Field(
        0.4, ge=0, le=1,
        description="error of points that are followed in pictures, over their distance from a rigid motion",
    )  # fmt: skip
    max_reduced_chi: float = Field(
        1.75, ge=1,
        description="reduced chi (residual over its standard deviation: noise and discretization) above which "
        "something is missing: a further effect is looked for, and if none is accepted, the residual is unexplained",
    )  # fmt: skip
    search_second_effect: bool = Field(
        True,
        description="if an effect was accepted and the reduced chi is below max_reduced_chi, look for one of one "
        "parameter in addition",
    )  # fmt: skip
    min_explained: float = Field(
        0.1, ge=0, le=1, description="part of the residual that an effect must explain in the ranking to be fitted"
    )
    min_gain: float = Field(
        0.15, ge=0, le=1,
        description="part of the held-out error that an effect must remove if it explains more of the fitted motion "
        "than noise and discretization could change",
    )  # fmt: skip
    decisive_gain: float = Field(0.5, ge=0, le=1, description="the same if it explains next to nothing of that")
    single_parameter_gain: float = Field(
        0.25, ge=0, le=1, description="the same for an effect of one parameter, if the criterion is clear"
    )
    decisive_variance_ratio: float = Field(
        4.0, ge=1,
        description="variance that an effect must explain over that of the noise, in the instants that are simulated "
        "as well as observed, to be accepted although held-out frames confirm little and contradict nothing",
    )  # fmt: skip
    min_gls_z: float = Field(
        6.0, ge=0,
        description="standard deviations of a noise as smooth as the residual above which a variance ratio of 1 is "
        "enough there",
    )  # fmt: skip
    min_bic_gain: float = Field(
        6.0, ge=0,
        description="by how much an effect must lower the information criterion, to which held-out frames are one "
        "sample more; from 6 on evidence is called strong (Kass and Raftery, JASA 90, 1995)",
    )  # fmt: skip
    clear_bic_gain: float = Field(
        20.0, ge=0,
        description="gain of the criterion above which held-out frames need to confirm less: of an effect of one "
        "parameter, and of a second one",
    )  # fmt: skip
    min_strength_z: float = Field(3.0, ge=0, description="standard errors that a strength must lie from zero")
    min_vuong_z: float = Field(
        2.0, ge=0,
        description="standard deviations of smooth noise above which an effect is distinguished from another that "
        "explains less",
    )  # fmt: skip
    confusable_correlation: float = Field(
        0.95, gt=0, le=1, description="correlation of two patterns above which two effects are confusable"
    )
