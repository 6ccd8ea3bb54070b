"""Sections ``strategy`` (densification and pruning) and ``optim`` (learning rates)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Fraction, Positive, Section

_OF_30000 = "of a 30,000-step run, scaled with train.steps"
_PRUNE_OPACITY = "opacity below which Gaussians are pruned (kind=mcmc: relocated)"
_EVERY = "steps between densification steps; null: a twentieth of the run, at most 100"


class DefaultStrategy(Section):
    """Clone, split and prune by the gradient of the 2D means (3DGS, AbsGS as an option)."""

    kind: Literal["default"] = Field(
        default="default",
        description="clone, split and prune by the gradient of the 2D means (3DGS)",
    )
    absgrad: bool = Field(
        default=False,
        description="whether to use absolute pixel gradients for densification (AbsGS, Ye et al. "
        "2024); recommended with grad_threshold=8e-4",
    )
    grad_threshold: Positive = Field(
        default=2e-4,
        description="mean gradient norm of the 2D means, NDC units, above which Gaussians are "
        "cloned or split; lowered in runs of fewer than 30,000 steps",
    )
    start: int = Field(
        default=500, description=f"first step of densification and pruning, {_OF_30000}"
    )
    stop: int = Field(
        default=15_000, description=f"last step of densification and pruning, {_OF_30000}"
    )
    every: int | None = Field(default=None, ge=1, description=_EVERY)
    prune_opacity: Fraction = Field(default=0.005, description=_PRUNE_OPACITY)
    prune_above: int = Field(
        default=0,
        ge=0,
        description="number of Gaussians above which transparent and too large ones are pruned; "
        "4DGS: 200,000",
    )
    reset_every: int | None = Field(
        default=3000,
        ge=1,
        description=f"steps between opacity resets to 0.01, {_OF_30000}, at least 400; null: never",
    )
    prune_pixels: float = Field(
        default=0.0,
        ge=0,
        description="after densification, prune Gaussians whose contribution is below this many "
        "pixels in every training view; static scenes only; 0: off",
    )
    grow: bool = Field(
        default=True, description="whether to clone and split Gaussians; false: only prune"
    )
    max_gaussians: int = Field(
        default=3_000_000,
        ge=1,
        description="number of Gaussians at which densification stops; unless it is given, at most "
        "400 times the square root of the number of training pixels, and at least 100,000",
    )

    @property
    def growth_limit(self) -> int:
        """Number of Gaussians at which growth stops; 0: no growth."""
        return self.max_gaussians if self.grow else 0

    def limited(self, cap: int) -> DefaultStrategy:
        """Return this strategy with ``max_gaussians`` of at most ``cap``."""
        return self.model_copy(update={"max_gaussians": min(self.max_gaussians, cap)})


class McmcStrategy(Section):
    """3DGS-MCMC (Kheradmand et al. 2024): fixed cap, relocation, noise."""

    kind: Literal["mcmc"] = Field(
        default="mcmc",
        description="fixed cap, relocation of transparent Gaussians, noise (3DGS-MCMC, Kheradmand "
        "et al. 2024)",
    )
    max_gaussians: int = Field(
        default=300_000, ge=1, description="maximum number of Gaussians, reached by steady growth"
    )
    start: int = Field(
        default=500, description=f"first step of densification and pruning, {_OF_30000}"
    )
    stop: int = Field(
        default=25_000, description=f"last step of relocation and growth, {_OF_30000}"
    )
    every: int | None = Field(default=None, ge=1, description=_EVERY)
    prune_opacity: Fraction = Field(default=0.005, description=_PRUNE_OPACITY)
    noise: float = Field(
        default=5e5,
        ge=0,
        description="scale of the position noise, relative to the learning rate of positions; "
        "0: no noise",
    )
    opacity_reg: ClassVar[float] = 0.01  # weight of the mean opacity
    scale_reg: ClassVar[float] = 0.01  # weight of the mean scale, scene units

    @property
    def growth_limit(self) -> int:
        return self.max_gaussians

    def limited(self, cap: int) -> McmcStrategy:
        return self.model_copy(update={"max_gaussians": min(self.max_gaussians, cap)})


class FixedStrategy(Section):
    """Fixed set of Gaussians: none are added or removed."""

    kind: Literal["fixed"] = Field(default="fixed", description="no Gaussians are added or removed")

    @property
    def start(self) -> int:
        return 0

    @property
    def stop(self) -> int:
        return 0

    @property
    def growth_limit(self) -> int:
        return 0

    def limited(self, cap: int) -> FixedStrategy:
        return self


Strategy = DefaultStrategy | McmcStrategy | FixedStrategy


class OptimConfig(Section):
    """Learning rates of Adam; defaults of 3DGS."""

    rate_factor: float | None = Field(
        default=None,
        gt=0,
        description="factor on all learning rates; null: 1, but 2 for free primitives and clips, "
        "and in static scenes of 500 to 30,000 steps the square root of 30000 / train.steps for "
        "positions, its cube root for the others",
    )
    lr_means: Positive = Field(
        default=1.6e-4, description="learning rate of positions, times the scene extent"
    )
    lr_means_final: Positive = Field(
        default=1.6e-6,
        description="learning rate of positions at the end of the run (exponential decay)",
    )
    lr_sh_dc: Positive = Field(default=2.5e-3, description="learning rate of base colours")
    lr_sh_rest: Positive = Field(
        default=1.25e-4, description="learning rate of the SH coefficients of degree 1 and higher"
    )
    lr_opacities: Positive = Field(default=0.05, description="learning rate of opacities (logits)")
    lr_scales: Positive = Field(default=5e-3, description="learning rate of log-scales")
    lr_quats: Positive = Field(default=1e-3, description="learning rate of rotations (quaternions)")
