"""Small radiance fields of a small capture, for tests."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import Config
from dyngs.config.io import load_config

NGP = [
    "model.kind=ngp",
    "model.levels=6",
    "model.log2_rows=12",
    "model.finest=128",
    "model.log2_samples=12",
    "model.cells=32",
]
NERF = [
    "model.kind=nerf",
    "model.width=32",
    "model.coarse=12",
    "model.fine=12",
    "model.rays=64",
    "model.lr=2e-3",
]


def config_of(capture: Path, *keys: str) -> Config:
    return load_config(None, [f"data.root={capture}", "run.threads=1", *keys])
