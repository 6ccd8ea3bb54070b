"""Behaviour shared by all scene predictors: views by name, and weights of another network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.models.prediction import (
    find_views,
    load_optimizer,
    load_weights,
    optimizer_state,
    optimizer_step,
)


def test_views_by_name() -> None:
    """In the order given; of the view, or of its file."""
    views = [View(f"a/{i}", Path(f"a/{i}.png"), np.eye(4), np.eye(3), 8, 8) for i in range(6)]
    assert find_views("ann", views, ["5.png", "a/2"]) == [5, 2]
    with pytest.raises(
        DyngsError, match="ann: no training view is named 'nobody'; the first is 'a/0'"
    ):
        find_views("ann", views, ["nobody"])
    with pytest.raises(DyngsError, match="named twice"):
        find_views("ann", views, ["5.png", "a/5"])


def stored(network: nn.Module) -> Checkpoint:
    tensors = {f"model.network.{name}": x for name, x in network.state_dict().items()}
    return Checkpoint(CheckpointInfo(3, 1.0, (0.0, 0.0, 0.0), "white", "classic"), tensors)


def test_weights_of_another_network_are_refused() -> None:
    own = nn.Linear(3, 2)
    load_weights(nn.Linear(3, 2), stored(own))
    for other in (nn.Linear(3, 3), nn.Sequential(nn.Linear(3, 2))):
        with pytest.raises(DyngsError, match="the checkpoint of step 3 is not of this network"):
            load_weights(other, stored(own))


def test_parameters_without_gradients_have_no_moments() -> None:
    """Parameters without gradients have no moments after a restore; the others train to identical
    bytes."""
    networks = [nn.ModuleList([nn.Linear(3, 2), nn.Linear(3, 2)]) for _ in range(2)]
    networks[1].load_state_dict(networks[0].state_dict())
    optimizers = [torch.optim.AdamW(network.parameters()) for network in networks]
    data = torch.ones(1, 3)
    assert optimizer_step(optimizers[0], networks[0], networks[0][0](data).sum(), 1e-3)
    networks[1].load_state_dict(networks[0].state_dict())
    state = optimizer_state(optimizers[0], networks[0])
    assert sorted(state) == [
        f"{key}.0.{x}" for key in ("exp_avg", "exp_avg_sq", "step") for x in ("bias", "weight")
    ]
    load_optimizer(optimizers[1], networks[1], state)
    for network, optimizer in zip(networks, optimizers, strict=True):
        assert optimizer_step(
            optimizer, network, sum(layer(data).square().sum() for layer in network), 1e-3
        )
    assert all(torch.equal(a, b) for a, b in zip(*(n.parameters() for n in networks), strict=True))
    with pytest.raises(KeyError):
        load_optimizer(optimizers[1], networks[1], {"step.0.bias": torch.tensor(1.0)})
