"""Every view once per epoch, in an order that the seed decides and a checkpoint keeps."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.training.sampler import ViewSampler


def anything(index: int) -> bool:
    return True


def test_each_epoch_is_a_new_permutation() -> None:
    sampler, generator = ViewSampler(20), torch.Generator().manual_seed(0)
    first, second = ([sampler.next(generator, anything) for _ in range(20)] for _ in range(2))
    assert sorted(first) == sorted(second) == list(range(20))
    assert first != second


def test_a_restored_sampler_goes_on_as_if_never_stopped() -> None:
    sampler, generator = ViewSampler(5), torch.Generator().manual_seed(1)
    for _ in range(7):
        sampler.next(generator, anything)
    other, again = ViewSampler(5), torch.Generator()
    other.load_state({name: x.clone() for name, x in sampler.state().items()})
    again.set_state(generator.get_state())
    assert [sampler.next(generator, anything) for _ in range(9)] == [other.next(again, anything) for _ in range(9)]


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 9), min_size=1), st.integers(0, 100))
def test_only_what_is_wanted_is_drawn_and_each_once_per_epoch(wanted: set[int], seed: int) -> None:
    sampler, generator = ViewSampler(10), torch.Generator().manual_seed(seed)
    for _ in range(3):
        epoch = [sampler.next(generator, lambda i: i in wanted) for _ in wanted]
        assert sorted(epoch) == sorted(wanted)


def test_views_that_are_not_wanted_do_not_cost_randomness() -> None:
    """As long as an epoch lasts, whatever is passed over: the generator is drawn from once."""
    sampler, generator = ViewSampler(6), torch.Generator().manual_seed(0)
    sampler.next(generator, lambda i: i == 3)
    state = generator.get_state()
    rest = 6 - int(sampler.state()["position"])
    for _ in range(rest):
        sampler.next(generator, anything)
    assert torch.equal(generator.get_state(), state)
