"""Small radiance fields of a small capture, for tests."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import Config
from dyngs.config.io import load_config

NGP = ["model.kind=ngp", "model.sizes=tiny"]
NERF = ["model.kind=nerf", "model.sizes=tiny"]


def config_of(capture: Path, *keys: str) -> Config:
    return load_config(None, [f"data.root={capture}", "run.threads=1", *keys])
