"""Section ``colour``: colour representation of the Gaussians."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from dyngs.core.section import Section

MEASURED_AT = 0.6  # fraction of the run after which view dependence is measured


class ColourSection(Section):
    """Keys shared by all colour representations."""

    opacity_entropy: float = Field(
        default=0.0,
        ge=0,
        description="weight of the opacity entropy loss, the mean of -o ln o over opacities o, "
        "which removes faint Gaussians; they are then pruned to the end of the run; MEGA: 5e-4",
    )

    def stored_degree(self, sh_degree: int) -> int:
        """Return the degree of the trained SH coefficients for ``model.sh_degree``."""
        return sh_degree

    def measurement_step(self, steps: int) -> int | None:
        """Return the step after which view dependence is measured; None if it never is."""
        return None


class ShColour(ColourSection):
    """Spherical harmonics of degree ``model.sh_degree`` for all Gaussians."""

    kind: Literal["sh"] = Field(
        default="sh", description="spherical harmonics of degree model.sh_degree for all Gaussians"
    )


class NetworkColour(ColourSection):
    """A base colour per Gaussian and a shared network for view and time dependence (MEGA, Zhang et
    al. 2024)."""

    kind: Literal["network"] = Field(
        default="network",
        description="a base colour per Gaussian plus a small shared network that adds view and time "
        "dependence (MEGA, Zhang et al. 2024)",
    )
    width: int = Field(default=32, ge=1, description="neurons per hidden layer; MEGA: 64")
    depth: int = Field(default=2, ge=1, le=8, description="number of hidden layers")
    normals: bool = Field(
        default=True,
        description="whether the network also gets the normal of the Gaussian; MEGA: false",
    )
    lr: ClassVar[float] = 0.01
    """Learning rate of the network; divided by 3 after 1/6, 1/2 and 5/6 of the run."""

    def stored_degree(self, sh_degree: int) -> int:
        """Return 0, because the network models view dependence."""
        return 0


class AutoColour(ColourSection):
    """Spherical harmonics only for Gaussians whose view dependence improves held-out views."""

    kind: Literal["auto"] = Field(
        default="auto",
        description="spherical harmonics only for Gaussians whose view dependence improves every "
        "8th training view, measured after 60 % of the run",
    )
    tolerance: float = Field(default=0.05, ge=0, description="largest loss of PSNR, dB")

    def measurement_step(self, steps: int) -> int:
        return max(1, round(MEASURED_AT * steps))
