"""Offsets added in place; what they mean is tested where it is defined, in tests/deform/test_field.py."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import cloud

from dyngs.errors import DyngsError
from dyngs.ops.offsets import add_offsets_, add_offsets_op


def test_every_isa_moves_the_rows_and_no_others(isa: str) -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    before = [x.clone() for x in tensors]
    rows, shift = torch.tensor([7, 2]), torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    add_offsets_(tensors, rows, (shift, None, None, torch.tensor([0.5, -0.5]), None))
    means, logits = before[0].clone(), before[3].clone()
    means[rows] += shift
    logits[rows] += torch.tensor([0.5, -0.5])
    for found, expected in zip(tensors, (means, before[1], before[2], logits, before[4]), strict=True):
        assert torch.equal(found, expected), isa


def test_a_row_that_does_not_exist_is_refused() -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    with pytest.raises(IndexError, match="no such Gaussian"):
        add_offsets_(tensors, torch.tensor([9]), (torch.zeros(1, 3), None, None, None, None))


def test_what_is_written_to_must_be_contiguous() -> None:
    means, *others = (x.clone() for x in cloud().tensors().values())
    strided = means.T.contiguous().T
    with pytest.raises(DyngsError, match="must be contiguous"):
        add_offsets_((strided, *others), None, (torch.zeros(1, 3), None, None, None, None))


def test_only_what_gets_offsets_counts_as_changed() -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    add_offsets_(tensors, None, (torch.zeros(1, 3), None, None, torch.zeros(1), None))
    assert [x._version for x in tensors] == [1, 0, 0, 1, 0]


@pytest.mark.parametrize("all_of_them", [True, False])
def test_is_a_well_behaved_torch_op(all_of_them: bool) -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    by_means, *others = (torch.ones(2, *width) for width in ((3,), (4,), (3,), (), (3,)))
    given = others if all_of_them else [None] * 4
    torch.library.opcheck(add_offsets_op, (*tensors, torch.tensor([7, 2]), by_means, *given))
