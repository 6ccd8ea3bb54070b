"""Deformation offsets affect only their attribute and the selected rows."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import weights
from scipy.spatial.transform import Rotation
from tiny_fields import KINDS, TIMES, cloud, stirred_field, tiny_field
from torch import Tensor

from dyngs.deform.field import Offsets, apply_offsets
from dyngs.gaussians import Gaussians
from dyngs.ops.quaternions import identity_quat, quat_product

SHAPES = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "colors": (3,)}

ATTRIBUTES = ["quats", "log_scales", "logit_opacities", "colors"]


def some_offsets(count: int, dtype: torch.dtype = torch.float32, seed: int = 1) -> Offsets:
    generator = torch.Generator().manual_seed(seed)
    values = {
        k: 0.3 * torch.randn((count, *s), generator=generator, dtype=dtype)
        for k, s in SHAPES.items()
    }
    return Offsets(**values)


def rotations(quats: Tensor) -> Rotation:
    return Rotation.from_quat(quats.double().roll(-1, 1).numpy())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("everything", [True, False])
def test_every_field_starts_as_the_identity(kind: str, everything: bool) -> None:
    """Bitwise, at any time and for any set of attributes."""
    gaussians = cloud()
    field = tiny_field(kind, everything=everything)
    for time in TIMES:
        moved = apply_offsets(gaussians, field.offsets(gaussians.means, time))
        for name, x in gaussians.tensors().items():
            assert torch.equal(getattr(moved, name), x), (name, time)


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_gets_a_gradient(kind: str) -> None:
    """After some training, because in the first step only the zero last layer has gradients."""
    gaussians = cloud()
    for field, trained in ((stirred_field(kind), True), (tiny_field(kind), False)):
        outputs = [x for x in vars(field.offsets(gaussians.means, 0.37)).values() if x is not None]
        torch.stack([(x * weights(x)).sum() for x in outputs]).sum().backward()
        names = list(field.parameters.values())
        reached = {
            name
            for name in names
            if field.parameters[name].grad is not None and field.parameters[name].grad.any()
        }
        first = set(names[-2:]) if kind in ("hexplane", "mlp") else set(names)
        assert reached == (set(names) if trained else first)


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, 8)), st.sets(st.sampled_from(ATTRIBUTES)))
def test_only_selected_rows_are_deformed(chosen: set[int], absent: set[str]) -> None:
    gaussians = cloud()
    rows = torch.tensor(sorted(chosen), dtype=torch.long)
    offsets = Offsets(
        **{k: None if k in absent else x for k, x in vars(some_offsets(len(rows))).items()}
    )
    moved = apply_offsets(gaussians, offsets, rows)
    alone = apply_offsets(gaussians.select(rows), offsets)
    others = torch.tensor([i for i in range(9) if i not in chosen], dtype=torch.long)
    for name, x in gaussians.tensors().items():
        assert torch.equal(getattr(moved, name)[rows], getattr(alone, name)), name
        assert torch.equal(getattr(moved, name)[others], x[others]), name


@settings(max_examples=40, deadline=None)
@given(
    st.none() | st.sets(st.integers(0, 8)),
    st.sets(st.sampled_from(ATTRIBUTES)),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_values_and_gradients_are_those_of_plain_torch(
    chosen: set[int] | None, absent: set[str], dtype: torch.dtype
) -> None:
    rows = None if chosen is None else torch.tensor(sorted(chosen), dtype=torch.long)
    given = vars(some_offsets(9 if rows is None else len(rows), dtype)).items()
    found: list[list[Tensor]] = []
    for move in (apply_offsets, slowly_deformed):
        leaves = {
            name: x.to(dtype).clone().requires_grad_() for name, x in cloud().tensors().items()
        }
        offsets = {
            name: None if name in absent else x.clone().requires_grad_() for name, x in given
        }
        moved = move(Gaussians(**leaves), Offsets(**offsets), rows).tensors().values()
        weighted = torch.stack([(x * weights(x)).sum() for x in moved]).sum()
        weighted.backward()
        inputs = [*leaves.values(), *(x for x in offsets.values() if x is not None)]
        found.append([*moved, *(x.grad for x in inputs if x.grad is not None)])
        assert len(found[-1]) == 5 + len(inputs)
        for name, x in cloud().tensors().items():
            assert torch.equal(leaves[name].detach(), x.to(dtype)), "what is given stays as it is"
    for fast, slow in zip(*found, strict=True):
        torch.testing.assert_close(fast, slow)


def turned_quats(quats: Tensor, offsets: Tensor) -> Tensor:
    """Return (M, 4) ``quats`` multiplied by identity + ``offsets`` (Hamilton product), not
    normalised.
    """
    return quat_product(offsets + identity_quat(offsets), quats)


def slowly_deformed(gaussians: Gaussians, offsets: Offsets, rows: Tensor | None) -> Gaussians:
    """Reference of ``apply_offsets`` by torch's own operators."""
    rows = torch.arange(len(gaussians)) if rows is None else rows
    sh = gaussians.sh
    quats = gaussians.quats
    changes = dict[str, Tensor]()
    for name in ("means", "log_scales", "logit_opacities"):
        offset = getattr(offsets, name)
        if offset is not None:
            changes[name] = getattr(gaussians, name).index_add(0, rows, offset)
    if offsets.quats is not None:
        changes["quats"] = quats.index_copy(0, rows, turned_quats(quats[rows], offsets.quats))
    if offsets.colors is not None:
        changes["sh"] = torch.cat(
            [sh[:, 0].index_add(0, rows, offsets.colors)[:, None], sh[:, 1:]], dim=1
        )
    return gaussians.replace(**changes)


@pytest.mark.parametrize("rows", [None, (0, 2, 3)], ids=["all", "some"])
def test_gradcheck_of_deformed(rows: tuple[int, ...] | None) -> None:
    gaussians = Gaussians(**{k: x.double() for k, x in cloud(4).tensors().items()})
    index = None if rows is None else torch.tensor(rows)
    offsets = some_offsets(4 if rows is None else len(rows), torch.float64)
    leaves = [
        x.detach().requires_grad_()
        for x in (*gaussians.tensors().values(), *vars(offsets).values())
    ]

    def moved(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(
            apply_offsets(Gaussians(*tensors[:5]), Offsets(*tensors[5:]), index).tensors().values()
        )

    assert torch.autograd.gradcheck(moved, leaves)
