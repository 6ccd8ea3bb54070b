"""Every view once per epoch, in an order that the seed decides and a checkpoint keeps."""

from __future__ import annotations

import torch

from dyngs.train.sampler import ViewSampler


def test_each_epoch_is_a_new_permutation() -> None:
    sampler, generator = ViewSampler(20), torch.Generator().manual_seed(0)
    first, second = ([sampler.next(generator) for _ in range(20)] for _ in range(2))
    assert sorted(first) == sorted(second) == list(range(20))
    assert first != second


def test_a_restored_sampler_goes_on_as_if_never_stopped() -> None:
    sampler, generator = ViewSampler(5), torch.Generator().manual_seed(1)
    for _ in range(7):
        sampler.next(generator)
    other, again = ViewSampler(5), torch.Generator()
    other.load_state({name: x.clone() for name, x in sampler.state().items()})
    again.set_state(generator.get_state())
    assert [sampler.next(generator) for _ in range(9)] == [other.next(again) for _ in range(9)]
