"""Section ``run``: where the run goes and how it is executed."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dyngs.config.keys.section import Section


class RunConfig(Section):
    """Where the run goes and how it is executed."""

    name: str = Field(default="static", description="name of the run; names its folder")
    dir: Path | None = Field(default=None, description="run folder; null: runs/NAME")
    seed: int = Field(default=42, ge=0, lt=2**63, description="seed of all random numbers")
    threads: int = Field(default=0, ge=0, le=1024, description="CPU threads; 0: one per core")
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto", description="what computes; auto: a CUDA GPU that can be used (docs/gpu.md), else the CPU"
    )
    deterministic: bool = Field(
        default=True, description="on a GPU: the same bytes on every run; false may be faster (the CPU's always are)"
    )
