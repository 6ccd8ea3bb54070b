"""Section ``colour``: what the colour of a Gaussian is made of."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Section

MEASURED_AT = 0.6  # Fraction of a run after which it is measured whose harmonics pay


class ColourSection(Section):
    """Keys that all kinds of colour share."""

    opacity_entropy: float = Field(
        default=0.0,
        ge=0,
        description="weight of the mean of -o ln o over opacities o, which removes faint Gaussians; MEGA: 5e-4",
    )

    def stored_degree(self, sh_degree: int) -> int:
        """Return the degree of the harmonics that training begins with, of ``model.sh_degree``."""
        return sh_degree

    def measurement_step(self, steps: int) -> int | None:
        """Return the step after which it is measured whose harmonics pay; None where it never
        is."""
        return None


class ShColour(ColourSection):
    """Spherical harmonics of degree ``model.sh_degree`` for every Gaussian."""

    kind: Literal["sh"] = Field(
        default="sh", description="spherical harmonics of degree model.sh_degree for every Gaussian"
    )


class NetworkColour(ColourSection):
    """Three base values per Gaussian and one small network for all (MEGA, Zhang et al. 2024); no
    harmonics."""

    kind: Literal["network"] = Field(
        default="network",
        description="a base colour (DC) per Gaussian, to which one small network for all adds what depends on "
        "direction and time (AC; MEGA, Zhang et al. 2024); no harmonics",
    )
    width: int = Field(default=32, ge=1, description="neurons per hidden layer; MEGA: 64")
    depth: int = Field(default=2, ge=1, le=8, description="hidden layers")
    lr: ClassVar[float] = 0.01
    """Learning rate of the network; divided by 3 after 1/6, 1/2 and 5/6 of the run."""

    def stored_degree(self, sh_degree: int) -> int:
        """Return 0: the network gives what depends on the view."""
        return 0


class AutoColour(ColourSection):
    """Harmonics only for the Gaussians whose dependence on the view pays on held-out training
    views."""

    kind: Literal["auto"] = Field(
        default="auto",
        description="harmonics only for the Gaussians where dependence on the view pays, measured after 0.6 of the run "
        "on every 8th training view",
    )
    tolerance: float = Field(default=0.05, ge=0, description="PSNR that may be lost by it, dB")

    def measurement_step(self, steps: int) -> int:
        return max(1, round(MEASURED_AT * steps))
