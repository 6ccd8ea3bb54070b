"""The set of Gaussians: shapes, activations, and edits of its topology."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import random_scene

from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians, TopologyEdit


def five() -> Gaussians:
    return random_scene(n=5, degree=2).gaussians


def test_activations() -> None:
    scene = random_scene(n=5)
    torch.testing.assert_close(scene.gaussians.scales, scene.scales)
    torch.testing.assert_close(scene.gaussians.opacities, scene.opacities)
    torch.testing.assert_close(scene.gaussians.base_rgb, scene.sh[:, 0] * SH_C0 + 0.5)


def test_sh_degree() -> None:
    assert [random_scene(n=2, degree=d).gaussians.sh_degree for d in range(5)] == [0, 1, 2, 3, 4]


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


def test_select_takes_rows_of_everything() -> None:
    gaussians = five()
    picked = gaussians.select(torch.tensor([3, 1, 3]))
    assert len(picked) == 3
    for name, x in picked.tensors().items():
        assert torch.equal(x, gaussians.tensors()[name][[3, 1, 3]])
    mask = torch.tensor([True, False, False, False, True])
    assert torch.equal(gaussians.select(mask).means, gaussians.means[mask])


def test_detach_cuts_the_graph() -> None:
    gaussians = five().replace(means=five().means.requires_grad_())
    assert gaussians.means.requires_grad
    assert not gaussians.detach().means.requires_grad


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


def test_replace_leaves_the_rest() -> None:
    gaussians = five()
    other = gaussians.replace(means=gaussians.means + 1)
    assert other.quats is gaussians.quats
    assert torch.equal(other.means, gaussians.means + 1)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.booleans(), min_size=5, max_size=5))
def test_keep_is_the_mask(mask: list[bool]) -> None:
    edit = TopologyEdit.select(torch.tensor(mask))
    x = torch.arange(10).view(5, 2)
    assert torch.equal(edit.apply(x), x[torch.tensor(mask)])
    assert torch.equal(edit.apply_moments(x), edit.apply(x))


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
    with pytest.raises(ValueError, match=r"'log_scales' holds sizes beyond e\^88"):
        Gaussians.stored(tensors)


def test_joined_parts_follow_each_other() -> None:
    whole = five()
    first = torch.tensor([0, 1])
    rest = torch.tensor([2, 3, 4])
    both = Gaussians.joined([whole.select(first), whole.select(rest)])
    assert all(torch.equal(x, both.tensors()[name]) for name, x in whole.tensors().items())
