"""The numbers of scenes: how many, of what, and how large."""

from __future__ import annotations

import base64
import zlib
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scene_kinds import KINDS, scene_of_kind

from dyngs.export.html.numbers import CHUNK, Lists, add_scene
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.ops.quaternions import rotation_matrices


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_the_lists_that_it_needs(kind: str) -> None:
    scene = scene_of_kind(kind)
    lists = Lists()
    told = add_scene(scene, lists, 0.01)
    layout = lists.layout
    assert (told["count"], told["moves"]) == (len(scene), not scene.is_static)
    for name, columns in {
        "means": 3,
        "quats": 4,
        "log_scales": 3,
        "logit_opacities": 1,
        "base": 3,
    }.items():
        assert (layout[name]["rows"], layout[name]["columns"]) == (len(scene), columns)
    assert ("boned" in layout, "bones" in told) == (kind == "human",) * 2
    assert ("masks" in layout) == (kind == "masked")
    assert ("pivots" in layout) == (kind in ("control_nodes", "windowed"))
    assert ("windows" in layout) == (kind == "windowed")
    assert ("network" in told) == (scene.colour is not None)
    assert ("rest" in layout) == (scene.colour is None and scene.gaussians.sh_degree > 0)
    assert ("curve_means" in layout) == (kind != "static")


def test_lists_lie_one_after_the_other() -> None:
    lists = Lists()
    add_scene(scene_of_kind("control_nodes"), lists, 0.01)
    places = sorted(told["at"] for told in lists.layout.values())
    assert places[0] == 0
    assert len(set(places)) == len(places)
    assert places[-1] < lists.size


def read(lists: Lists, name: str) -> NDArray[Any]:
    """A list as ``data.js`` reads it."""
    told = lists.layout[name]
    data = zlib.decompress(base64.b64decode(lists.text()))[told["at"] :]
    rows = told["rows"]
    columns = told["columns"]
    if told["kind"] != "quantised":
        return np.frombuffer(data, told["kind"], rows * columns).reshape(rows, columns)
    count = -(-rows // told["chunk"])
    ranges = (
        np.frombuffer(data, "<f4", 2 * count * columns)
        .reshape(count, columns, 2)
        .repeat(told["chunk"], axis=0)
    )
    planes = told["bits"] // 8
    steps = np.frombuffer(data, np.uint8, planes * rows * columns, ranges.nbytes // told["chunk"])
    steps = steps.reshape(columns, planes, rows).astype(int)
    whole = steps[:, 0] if planes == 1 else steps[:, 0] * 256 + steps[:, 1]
    return ranges[:rows, :, 0] + ranges[:rows, :, 1] * whole.T


def test_rotations_of_a_clip_begin_with_their_scalar_part() -> None:
    scene = scene_of_kind("human")
    lists = Lists()
    add_scene(scene, lists, 0.01)
    found = torch.from_numpy(read(lists, "clip_quats").reshape(-1, 4))
    person = avatar_of(scene)
    assert person is not None
    wanted = axis_angle_to_matrix(person.moves_as.poses.reshape(-1, 3)).double()
    torch.testing.assert_close(rotation_matrices(found.double()), wanted, rtol=0, atol=1e-3)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("rows", [1, CHUNK, CHUNK + 3])
def test_quantised_lists_err_by_half_a_step(bits: Literal[8, 16], rows: int) -> None:
    values = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    values[:, 1] = 7.25  # the same everywhere: exact
    values[0, 0] = 1000.0  # far away: spoils its own chunk alone
    lists = Lists()
    lists.exact("before", np.arange(5, dtype=np.uint8)[:, None])
    lists.quantised("values", values, bits)
    found = read(lists, "values")
    assert np.array_equal(found[:, 1], values[:, 1])
    for start in range(0, rows, CHUNK):
        part = slice(start, start + CHUNK)
        spread = np.ptp(values[part].astype(np.float64), axis=0)
        assert (
            np.abs(found[part] - values[part]) <= 0.501 * spread / (2**bits - 1) + 1e-4 * 2.0**-bits
        ).all()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_exact_lists_stay_as_they_are(kind: type[np.generic]) -> None:
    values = np.arange(300).reshape(100, 3).astype(kind)
    lists = Lists()
    lists.exact("first", values[:1])
    lists.exact("values", values)
    assert np.array_equal(read(lists, "values"), values)
    with pytest.raises(ValueError, match="int64"):
        lists.exact("other", np.arange(3)[:, None])
