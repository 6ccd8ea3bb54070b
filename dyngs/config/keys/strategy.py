"""Sections ``strategy`` and ``optim``: how the set of Gaussians grows and shrinks, and how fast
they learn."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Fraction, Positive, Section

_OF_30000 = "of a 30,000-step run, scaled with train.steps"
_PRUNE_OPACITY = "Gaussians with a lower opacity are removed; relocated with kind=mcmc"
_EVERY = "steps between these changes; null: a twentieth of the run, 100 at most"


class DefaultStrategy(Section):
    """Clone, split and prune by the gradient of the 2D means (3DGS, AbsGS as an option)."""

    kind: Literal["default"] = Field(
        default="default",
        description="clone, split and prune by the gradient of the 2D means (3DGS)",
    )
    absgrad: bool = Field(
        default=False,
        description="sum absolute gradients of pixels (AbsGS, Ye et al. 2024); grad_threshold=8e-4 suits",
    )
    grad_threshold: Positive = Field(
        default=2e-4,
        description="Gaussians with a larger mean gradient of their 2D mean, NDC units, are cloned or split; lowered "
        "in runs shorter than 30,000 steps",
    )
    start: int = Field(
        default=500, description=f"step {_OF_30000}, after which Gaussians are added and removed"
    )
    stop: int = Field(
        default=15_000, description=f"step {_OF_30000}, from which their number is fixed"
    )
    every: int | None = Field(default=None, ge=1, description=_EVERY)
    prune_opacity: Fraction = Field(default=0.005, description=_PRUNE_OPACITY)
    reset_every: int | None = Field(
        default=3000,
        ge=1,
        description=f"steps, {_OF_30000}, between resets of opacity to 0.01, 400 steps of this run at least; "
        "null: never",
    )
    prune_pixels: float = Field(
        default=0.0,
        ge=0,
        description="when no more Gaussians are added, those are removed that make up less than so many pixels of "
        "every training view; static scenes only; 0: none",
    )
    grow: bool = Field(
        default=True, description="clone and split Gaussians; false: they are only removed"
    )
    max_gaussians: int = Field(
        default=3_000_000, ge=1, description="no Gaussians are added beyond so many"
    )

    @property
    def growth_limit(self) -> int:
        """Number of Gaussians from which on none are added; 0: none ever are."""
        return self.max_gaussians if self.grow else 0

    def limited(self, cap: int) -> DefaultStrategy:
        """Return this strategy with at most ``cap`` as its limit of growth."""
        return self.model_copy(update={"max_gaussians": min(self.max_gaussians, cap)})


class McmcStrategy(Section):
    """3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): a cap, relocation, noise."""

    kind: Literal["mcmc"] = Field(
        default="mcmc",
        description="a fixed cap, relocation of transparent Gaussians, noise (3DGS-MCMC, Kheradmand et al. 2024)",
    )
    max_gaussians: int = Field(
        default=300_000, ge=1, description="cap that the number of Gaussians grows to"
    )
    start: int = Field(
        default=500, description=f"step {_OF_30000}, after which Gaussians are added and removed"
    )
    stop: int = Field(
        default=25_000, description=f"step {_OF_30000}, from which their number is fixed"
    )
    every: int | None = Field(default=None, ge=1, description=_EVERY)
    prune_opacity: Fraction = Field(default=0.005, description=_PRUNE_OPACITY)
    noise: float = Field(
        default=5e5,
        ge=0,
        description="strength of the noise on positions, times their learning rate; 0: none",
    )
    opacity_reg: ClassVar[float] = 0.01  # weight of the mean opacity
    scale_reg: ClassVar[float] = 0.01  # weight of the mean scale, scene units

    @property
    def growth_limit(self) -> int:
        return self.max_gaussians

    def limited(self, cap: int) -> McmcStrategy:
        return self.model_copy(update={"max_gaussians": min(self.max_gaussians, cap)})


class FixedStrategy(Section):
    """The first Gaussians stay: none are added, none removed."""

    kind: Literal["fixed"] = Field(
        default="fixed", description="the first Gaussians stay, none are added or removed"
    )

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
    """Adam and the learning rates of Gaussians; defaults of 3DGS."""

    rate_factor: float | None = Field(
        default=None,
        gt=0,
        description="multiplies all rates below, also given ones; 1: exactly these; null: in static scenes those of "
        "positions by the square root of 30000 / train.steps, all others by its cube root; from 500 to 30000 steps",
    )
    lr_means: Positive = Field(
        default=1.6e-4, description="learning rate of positions, times the scene extent"
    )
    lr_means_final: Positive = Field(
        default=1.6e-6, description="the same at the end of the run, reached exponentially"
    )
    lr_sh_dc: Positive = Field(default=2.5e-3, description="learning rate of base colours")
    lr_sh_rest: Positive = Field(
        default=1.25e-4, description="learning rate of the other harmonics"
    )
    lr_opacities: Positive = Field(
        default=0.05, description="learning rate of the logits of opacities"
    )
    lr_scales: Positive = Field(default=5e-3, description="learning rate of log-scales")
    lr_quats: Positive = Field(default=1e-3, description="learning rate of rotations (quaternions)")
