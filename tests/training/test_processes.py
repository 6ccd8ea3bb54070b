"""Several processes: sums in their order, one choice for all, and an error where they have come
apart."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from several_processes import run_in, summed

from dyngs.core.errors import DyngsError
from dyngs.training.processes import Processes, _checksum


def test_views_are_shared_evenly_in_order_and_each_once() -> None:
    for size, batch in ((1, 1), (1, 5), (2, 2), (4, 12)):
        fractions = [Processes(rank, size).views_of_process(batch) for rank in range(size)]
        assert [view for fraction in fractions for view in fraction] == list(range(batch))
        assert len({len(fraction) for fraction in fractions}) == 1
    with pytest.raises(
        DyngsError,
        match="batch_size=3: must be a multiple of the number of processes, 2",
    ):
        Processes(0, 2).views_of_process(3)
    with pytest.raises(DyngsError, match="must be a multiple"):
        Processes(0, 2).views_of_process(0)


@pytest.mark.parametrize("changed", [0, 1, 5])
def test_the_checksum_sees_every_bit_and_place(changed: int) -> None:
    x = torch.tensor([0.0, 1.0, -2.5, 1e-30, 7.0, 8.0])
    before = _checksum({"x": x, "flags": x > 0})
    assert _checksum({"flags": x > 0, "x": x.clone()}) == before
    other = x.clone()
    other.view(torch.int32)[changed] += 1
    assert _checksum({"x": other, "flags": x > 0}) != before
    assert _checksum({"x": x.flip(0), "flags": x > 0}) != before
    assert _checksum({"x": x, "flags": x > 5}) != before


def test_sums_are_those_of_a_loop_and_what_differs_is_an_error_of_one_line(tmp_path: Path) -> None:
    codes, said = run_in(3, summed, tmp_path)
    assert codes == [2, 2, 2]
    lines = [line for text in said for line in text.splitlines()]
    assert len(lines) == 1, "one tells it, the others end without a word"
    assert "after step 8: Gaussians of process 1 differ from those of process 0" in lines[0]
