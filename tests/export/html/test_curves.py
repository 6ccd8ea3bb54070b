"""Motion as splines of drivers."""

from __future__ import annotations

import pytest
import torch
from tiny_fields import HEADS, KINDS, cloud, followed, stirred_field

from dyngs.deform.control_nodes import Nodes, spline_basis
from dyngs.deform.field import Offsets
from dyngs.export.html.curves import Curves, curves_of, fitted_curves


def played(curves: Curves, time: float) -> dict[str, torch.Tensor]:
    """The drivers' offsets at a time, by attribute."""
    points = curves.heads["means"].shape[1]
    fractions = spline_basis(torch.tensor([time]), points - 3)[0].float()
    return {name: torch.einsum("p,spd->sd", fractions, x) for name, x in curves.heads.items()}


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "control_nodes"])
def test_every_gaussian_has_its_own_driver_without_nodes(kind: str) -> None:
    means = cloud().means
    field = stirred_field(kind, len(means))
    curves = curves_of(field, means, 40, 1e-3)
    assert curves.followed is None
    assert len(curves.heads) == 1 + len(HEADS)
    scale = float(field.offsets(means, 0.3).means.detach().norm(dim=1).max())
    for time in (0.0, 0.31, 0.77, 1.0):
        truth = field.offsets(means, time)
        found = played(curves, time)
        assert (
            float((found["means"] - truth.means.detach()).norm(dim=1).median())
            < 0.05 * scale + curves.error
        )


def test_nodes_are_exact() -> None:
    means = cloud().means
    field = stirred_field("control_nodes", len(means))
    curves = curves_of(field, means, 40, 1e-3)
    assert curves.pivots is not None
    assert curves.followed is not None
    assert curves.fractions is not None
    assert curves.error == 0
    assert curves.followed.shape == curves.fractions.shape == (len(means), 4)
    torch.testing.assert_close(curves.fractions.sum(1), torch.ones(len(means)))
    nodes: Nodes = field.nodes_for(means)  # type: ignore[attr-defined]
    for time in (0.0, 0.31, 1.0):
        heads = played(curves, time)
        heads["logit_opacities"] = heads["logit_opacities"][:, 0]
        truth = field.offsets(means, time)
        found = followed(nodes, means, Offsets(**heads))
        for name, x in vars(truth).items():
            torch.testing.assert_close(getattr(found, name), x.detach(), atol=1e-5, rtol=1e-4)


def test_pieces_are_added_until_places_are_near() -> None:
    def swinging(time: float) -> Offsets:
        return Offsets(torch.tensor([[torch.tensor(30 * time).sin(), 0.0, 0.0]]))

    coarse, error = fitted_curves(swinging, 300, 0.5)
    fine, smaller = fitted_curves(swinging, 300, 0.001)
    assert coarse["means"].shape[1] < fine["means"].shape[1]
    assert error <= 0.5
    assert smaller <= 0.001
    limited, _ = fitted_curves(swinging, 20, 0.0)
    assert limited["means"].shape == (1, 2 * 19 + 3, 3)
    _, between_few_times = fitted_curves(swinging, 3, 0.01)
    assert between_few_times <= 0.01
