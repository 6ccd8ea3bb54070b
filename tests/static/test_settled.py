"""A strategy that does nothing, whatever it is told."""

from __future__ import annotations

import torch
from scenes import random_scene

from dyngs.static.settled import Settled


def test_nothing_changes() -> None:
    gaussians, generator = random_scene(n=5).gaussians, torch.Generator().manual_seed(1)
    before = {name: x.clone() for name, x in gaussians.tensors().items()}
    settled = Settled()
    settled.after_backward(100, torch.ones(1, 5, 4), torch.ones(1, 5, 2), (8, 8))
    settled.perturb(gaussians, 1.0, generator)
    settled.load_state({"grad_sum": torch.ones(3)})
    settled.limit(3)
    assert not settled.wants_signal(100)
    assert settled.edit(100, gaussians, generator) is None
    assert (settled.regularizers(gaussians), settled.state()) == ({}, {})
    assert all(torch.equal(x, before[name]) for name, x in gaussians.tensors().items())
    assert torch.equal(generator.get_state(), torch.Generator().manual_seed(1).get_state())
