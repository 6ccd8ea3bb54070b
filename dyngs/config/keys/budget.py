"""Section ``budget``: limits that a run keeps."""

from __future__ import annotations

from pydantic import Field

from dyngs.config.keys.section import Section


class BudgetConfig(Section):
    """Limits that a run keeps (docs/budget.md); null: none."""

    max_gaussians: int | None = Field(default=None, ge=1, description="most Gaussians at the end of the run")
    max_mb: float | None = Field(
        default=None, gt=0, description="largest size of `export/scene.dyngs`, 1e6 bytes; the file is then written"
    )
    min_fps: float | None = Field(
        default=None,
        gt=0,
        description="fewest training views drawn per second on this machine, with fewer Gaussians if need be",
    )
