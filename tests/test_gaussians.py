"""The set of Gaussians: shapes, activations, and edits of its topology."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_scene

from dyngs.gaussians import Gaussians, TopologyEdit


def five() -> Gaussians:
    return random_scene(n=5, degree=2).gaussians


def test_opacities_are_the_sigmoid_and_do_not_depend_on_the_number_of_threads(
    set_threads: Callable[[int], None],
) -> None:
    logits = torch.linspace(-100, 100, 100_001)
    found = []
    for n in (1, 2):
        set_threads(n)
        copies = five().select(torch.zeros(len(logits), dtype=torch.long))
        found.append(copies.replace(logit_opacities=logits).opacities)
    assert torch.equal(found[0], found[1])
    # below 1e-37 float32 has fewer digits
    torch.testing.assert_close(found[0].double(), logits.double().sigmoid(), rtol=1e-6, atol=1e-37)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (5, 2)),
        ("quats", (4, 4)),
        ("log_scales", (5,)),
        ("logit_opacities", (5, 1)),
        ("sh", (5, 3)),
        ("sh", (5, 1, 4)),
    ],
)
def test_wrong_shapes_are_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"{name} must be"):
        five().replace(**{name: torch.zeros(shape)})


def test_to_moves_and_converts_every_tensor() -> None:
    gaussians = five()
    moved = gaussians.to(device="meta", dtype=torch.float32)
    assert {(x.device.type, x.dtype) for x in moved.tensors().values()} == {("meta", torch.float32)}
    assert all(
        a is b
        for a, b in zip(
            gaussians.to().tensors().values(), gaussians.tensors().values(), strict=True
        )
    )


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), max_size=12))
def test_moments_of_new_rows_start_at_zero(rows: list[tuple[int, bool]]) -> None:
    source = torch.tensor([r for r, _ in rows], dtype=torch.long)
    is_new = torch.tensor([new for _, new in rows], dtype=torch.bool)
    edit = TopologyEdit(source, is_new)
    x = torch.rand(5, 3) + 1
    before = x.clone()
    assert torch.equal(edit.apply(x), x[source])
    assert torch.equal(edit.apply_moments(x), x[source] * (~is_new)[:, None])
    assert torch.equal(x, before)


def test_stored_sizes_beyond_float32_are_refused() -> None:
    """They would be drawn as infinite, long after the file that they came from."""
    tensors = random_scene().to(torch.float32).gaussians.tensors()
    tensors["log_scales"][2, 1] = 87.9
    Gaussians.stored(tensors)
    tensors["log_scales"][2, 1] = 88.5
    with pytest.raises(
        ValueError, match=r"'log_scales' has values above 88, which overflow float32"
    ):
        Gaussians.stored(tensors)
