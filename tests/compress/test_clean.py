"""Gaussians classified by shape and contribution; removal costs at most the allowed PSNR on
held-out views."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from scaled_files import FACTORS, scaled
from splat_scenes import cloud

from dyngs.api.train import train
from dyngs.compress.clean import classify_shapes, clean_file, clean_run, find_isolated
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.runs.checkpoint import load_run

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def run_dir(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of few steps, in which much that is random has stayed."""
    keys = (
        "train.steps=30",
        "init.kind=random",
        "init.num_random=300",
        "strategy.prune_pixels=0",
        "run.threads=1",
    )
    out = tmp_path_factory.mktemp("runs") / "run"
    return train(
        load_config(packaged_preset("static"), [f"data.root={still}", f"run.dir={out}", *keys])
    )


def spoiled() -> Gaussians:
    """200 good Gaussians, then a needle, a veil, a faint one and one far away."""
    good = cloud(204, 0)
    log_scales = torch.full((204, 3), -3.0)
    logits = torch.full((204,), 2.0)
    means = good.means.clone()
    log_scales[200, 0] = 2.0
    log_scales[201] = 0.0
    logits[201] = -3.0
    logits[202] = -7.0
    means[203] = torch.tensor([0.0, 300.0, 0.0])
    return good.replace(means=means, log_scales=log_scales, logit_opacities=logits)


def test_shapes() -> None:
    found = classify_shapes(spoiled(), spoiled().opacities)
    rows = {kind: torch.nonzero(x)[:, 0].tolist() for kind, x in found.items()}
    assert rows == {"needles": [200], "veils": [201], "faint": [202], "lone": [203]}
    assert not find_isolated(torch.zeros(4, 3)).any()


def test_files_without_cameras() -> None:
    told: list[str] = []
    kept = clean_file(spoiled(), told.append)
    assert torch.nonzero(~kept)[:, 0].tolist() == [200, 202, 203]
    assert "3 of 204 Gaussians go; without the cameras of a run" in told[-1]
    with pytest.raises(DyngsError, match="would remove all Gaussians"):
        clean_file(spoiled().select(torch.tensor([200, 202])), told.append)


@pytest.mark.parametrize("factor", FACTORS)
def test_the_same_goes_in_any_unit(factor: float) -> None:
    wanted = clean_file(spoiled(), lambda _: None)
    assert torch.equal(clean_file(scaled(spoiled(), factor), lambda _: None), wanted)


@pytest.mark.parametrize("allowed", [0.0, 0.2, 50.0])
def test_no_more_is_lost_than_allowed(allowed: float, run_dir: Path) -> None:
    told: list[str] = []
    again: list[str] = []
    kept = clean_run(run_dir, allowed, 1, None, told.append)
    assert torch.equal(kept, clean_run(run_dir, allowed, 1, None, again.append))
    assert told == again, "deterministic"
    change = float(told[-1].split("(")[1].split(")")[0])
    assert -allowed - 5e-4 <= change
    assert len(kept) == len(load_run(run_dir).scene)
    assert "1 training view held out" in told[-1]
    gone = [re.findall(r"([\d,]+) of ([\d,]+) Gaussian", line)[0] for line in told[:-1]]
    assert (allowed < 50) or all(went == there for went, there in gone)
    assert sum(int(went) for went, _ in gone) == int((~kept).sum()) > 0
