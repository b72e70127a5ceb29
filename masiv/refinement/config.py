"""Settings of refine. Light: no torch, no taichi."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

REMOVED_KEYS = (
    "noise_threshold", "max_reduced_chi", "search_second_effect", "min_gain", "decisive_gain", "single_parameter_gain",
    "decisive_variance_ratio", "min_gls_z", "min_bic_gain", "clear_bic_gain", "min_strength_z", "min_vuong_z",
    "confusable_correlation", "above_noise", "unexplained", "least_gain", "simple_gain", "decisive", "plain_sigmas",
    "least_bic", "clear_bic", "least_sigmas", "least_apart", "confusable", "second_look",
)  # fmt: skip
"""Thresholds of earlier versions, in whose place ``max_null_probability`` and ``min_predictive_p`` decide: runs may
have them."""
RENAMED_KEYS = {"least_explained": "min_explained"}
"""Keys of earlier versions: old name -> new name."""


class RefineConfig(BaseModel):
    """How hard to look for missing effects, and what is enough to accept one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processes: int = Field(
        0, ge=0, le=32,
        description="processes that fit effects in parallel; 0: one for each core that Taichi may use, four at most; "
        "on a GPU always one",
    )  # fmt: skip
    scheduler: str = Field(
        "", pattern=r"^$|^(tcp|tls|ucx)://\S+$",
        description="address of a Dask scheduler, as tcp://host:8786, in place of processes: candidates are "
        "fitted there",
    )  # fmt: skip
    particles: int = Field(1500, ge=100, description="particles of the rollouts; of tracks: tracks.particles")
    search_particles: int = Field(500, ge=100, description="particles of the short fits that choose the laws")
    samples_per_frame: int = Field(
        1, ge=1, le=16, description="instants per frame at which motions are compared; only whole frames are observed"
    )
    families: int = Field(2, ge=1, description="classical laws that compete, the best by their fit without any effect")
    laws: list[str] = Field([], description="families that compete; all if empty")
    effects: list[str] = Field(
        [], description="effects that are considered; if empty, the whole library but for effects on request"
    )  # fmt: skip
    baseline_rollouts: int = Field(45, ge=2, description="rollouts of each stage of a law's fit without effects")
    shortlist: int = Field(4, ge=1, description="effects that are fitted through the rollout, after the ranking")
    max_effects: int = Field(3, ge=1, description="effects that may be added")
    max_null_probability: float = Field(
        0.05, gt=0, lt=1,
        description="probability of a model with fewer effects below which one more is named",
    )  # fmt: skip
    min_predictive_p: float = Field(
        0.01, ge=0, lt=1,
        description="probability of a residual as large as that of the final model, below which it is unexplained "
        "(prior predictive check)",
    )  # fmt: skip
    test_fraction: float = Field(
        0.5, ge=0, lt=1,
        description="part of the frames that are not fitted, the last ones, which no decision sees: errors before and "
        "after are reported on them",
    )  # fmt: skip
    tracking_error: float = Field(
        0.4, ge=0, le=1,
        description="error of points that are followed in pictures, over their distance from a rigid motion",
    )  # fmt: skip
    camera_split: bool = Field(
        False,
        description="that error is at least half the difference of two reconstructions, each from half of the cameras; "
        "needs six cameras, and the time of the reconstruct stage twice",
    )  # fmt: skip
    min_explained: float = Field(
        0.1, ge=0, le=1,
        description="part of the residual that an effect must explain in the ranking to be fitted; if one does, so are "
        "those that explain nearly as much",
    )  # fmt: skip
