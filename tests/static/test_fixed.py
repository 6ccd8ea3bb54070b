"""A strategy that does nothing, whatever it is told."""

from __future__ import annotations

import torch
from scenes import random_scene

from dyngs.gaussians.densify import Densifier


def test_nothing_changes() -> None:
    gaussians, generator = random_scene(n=5).gaussians, torch.Generator().manual_seed(1)
    before = {name: x.clone() for name, x in gaussians.tensors().items()}
    fixed = Densifier()
    fixed.after_backward(100, torch.ones(1, 5, 4), torch.ones(1, 5, 2), (8, 8))
    fixed.perturb(gaussians, 1.0, generator)
    fixed.load_state({"grad_sum": torch.ones(3)})
    fixed.limit(3)
    assert not fixed.wants_signal(100)
    assert fixed.edit(100, gaussians, generator) is None
    assert (fixed.regularizers(gaussians), fixed.state()) == ({}, {})
    assert all(torch.equal(x, before[name]) for name, x in gaussians.tensors().items())
    assert torch.equal(generator.get_state(), torch.Generator().manual_seed(1).get_state())
