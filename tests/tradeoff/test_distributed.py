"""Every variant is measured once, and what is made from one another by one process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_scene import write_moving_run

from dyngs.api.train import num_cores
from dyngs.errors import DyngsError
from dyngs.tradeoff.distributed import SINGLE_PROCESS, ProcessGroup
from dyngs.tradeoff.variants import Variant

VARIANTS = st.builds(
    Variant,
    colour=st.sampled_from([None, "network"]),
    prune=st.sampled_from([0.0, 0.5, 0.7]),
    finetune=st.sampled_from([0, 9]),
    sh_degree=st.sampled_from([None, 0]),
    storage=st.sampled_from([None, "auto"]),
    scale=st.sampled_from([1.0, 0.5]),
)
NAMES = {"RANK": "1", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": "1"}


@given(st.lists(VARIANTS, unique=True, max_size=12), st.integers(1, 4))
def test_all_is_shared_out_once(variants: list[Variant], size: int) -> None:
    fractions = [ProcessGroup(rank, size).share(variants) for rank in range(size)]
    assert sorted(v.slug for fraction in fractions for v in fraction) == sorted(v.slug for v in variants)


def test_what_is_made_from_one_another_stays_together() -> None:
    tuned = Variant(prune=0.5, finetune=9)
    together = [tuned, Variant(prune=0.5, finetune=9, storage="auto"), Variant(prune=0.5, finetune=9, sh_degree=0)]
    others = [Variant(alpha_min=0.01), Variant(storage="auto"), Variant(), Variant(storage="auto", scale=0.5)]
    fractions = [ProcessGroup(rank, 2).share([*others, *together]) for rank in range(2)]
    assert any(set(together) <= set(fraction) for fraction in fractions)
    assert any({others[1], others[3]} <= set(fraction) for fraction in fractions)
    assert all(fractions)


def test_one_process_waits_for_nobody() -> None:
    SINGLE_PROCESS.wait()
    assert SINGLE_PROCESS.is_first
    assert SINGLE_PROCESS.cores == num_cores()


def test_what_torchrun_says(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in NAMES.items():
        monkeypatch.delenv(name, raising=False)
        assert ProcessGroup.from_environment() == SINGLE_PROCESS
        monkeypatch.setenv(name, value)
    assert ProcessGroup.from_environment() == ProcessGroup(1, 4, 2)
    assert not ProcessGroup.from_environment().is_first
    monkeypatch.setenv("RANK", "first")
    with pytest.raises(DyngsError, match="RANK, WORLD_SIZE, LOCAL_WORLD_SIZE must be numbers"):
        ProcessGroup.from_environment()


def test_two_processes_make_one_report(tmp_path: Path) -> None:
    run, out = write_moving_run(tmp_path), tmp_path / "out"
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "dyngs"]
    words = ["tradeoff", str(run), "--out", str(out), "--vary", "scale=0.5", "--rounds", "1", "--threads", "1"]
    subprocess.run([*torchrun, *words], check=True, capture_output=True, cwd=tmp_path)
    rows = (out / "tradeoff.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ["as it is", "scale=0.5"]
