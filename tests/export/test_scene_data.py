"""Scene data of a page: arrays in reading order, motion as splines, uniforms of shaders."""

from __future__ import annotations

import base64
import re
import zlib
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scene_kinds import scene_of_kind

from dyngs.deform.field import Offsets
from dyngs.deform.fields import WindowedField
from dyngs.deform.scene import DynamicScene
from dyngs.export import html
from dyngs.export.html.scene_data import CHUNK, PackedArrays, add_scene, fit_splines, motion_splines
from dyngs.human.avatar.scene import as_human_scene
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.ops.quaternions import rotation_matrices


def read(lists: PackedArrays, name: str) -> NDArray[Any]:
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
    lists = PackedArrays()
    add_scene(scene, lists, 0.01)
    found = torch.from_numpy(read(lists, "clip_quats").reshape(-1, 4))
    person = as_human_scene(scene)
    assert person is not None
    wanted = axis_angle_to_matrix(person.played_clip.poses.reshape(-1, 3)).double()
    torch.testing.assert_close(rotation_matrices(found.double()), wanted, rtol=0, atol=1e-3)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("rows", [1, CHUNK, CHUNK + 3])
def test_quantised_lists_err_by_half_a_step(bits: Literal[8, 16], rows: int) -> None:
    values = np.random.default_rng(0).normal(size=(rows, 3)).astype(np.float32)
    values[:, 1] = 7.25  # the same everywhere: exact
    values[0, 0] = 1000.0  # far away: spoils its own chunk alone
    lists = PackedArrays()
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


def test_pieces_are_added_until_places_are_near() -> None:
    def swinging(time: float) -> Offsets:
        return Offsets(torch.tensor([[torch.tensor(30 * time).sin(), 0.0, 0.0]]))

    coarse, error = fit_splines(swinging, 300, 0.5)
    fine, smaller = fit_splines(swinging, 300, 0.001)
    assert coarse["means"].shape[1] < fine["means"].shape[1]
    assert error <= 0.5
    assert smaller <= 0.001
    limited, _ = fit_splines(swinging, 20, 0.0)
    assert limited["means"].shape == (1, 2 * 19 + 3, 3)
    _, between_few_times = fit_splines(swinging, 3, 0.01)
    assert between_few_times <= 0.01


def test_windows_in_time_and_lines_are_stored_as_they_are() -> None:
    scene = scene_of_kind("windowed")
    assert isinstance(scene, DynamicScene)
    assert isinstance(scene.field, WindowedField)
    means = scene.gaussians.means[scene.moving]
    curves = motion_splines(scene.field, means, 3, 0.01)
    assert curves.windows is scene.field.edges
    lists = PackedArrays()
    header = add_scene(scene_of_kind("gaussians_4d"), lists, 0.01)
    assert header["lines"] == {"moving": 4, "least": 0.05, "waves": 2, "exact": True}
    assert "curves" not in header
    assert read(lists, "lines").shape == (4, 5)


FOLDER = files(html)
MAIN = r'(?<!\.)\bat\("(\w+)(?:\[0\])?"\)|list\("(\w+)"'
COPY = r'copy\.at\("(\w+)"\)'
SET = [
    ("renderer.js", "project.", MAIN),
    ("renderer.js", "splat.", r'splat\.at\("(\w+)"\)'),
    ("renderer.js", "copy.", COPY),
    ("triangles.js", "triangles.", MAIN),
    ("triangles.js", "copy.", COPY),
]
HARMONICS = {"uHarmonics"}  # set by drawing.js for both


@pytest.mark.parametrize(("program", "shader", "names"), SET)
def test_the_script_sets_the_uniforms_that_a_shader_has(
    program: str, shader: str, names: str
) -> None:
    script = (FOLDER / program).read_text(encoding="utf-8")
    paths = [
        path
        for path in FOLDER.iterdir()
        if path.name.startswith(shader) and path.name.endswith(".glsl")
    ]
    declared = {
        name
        for path in paths
        for name in re.findall(r"\buniform (?:\w+ )+(\w+)", path.read_text("utf-8"))
    }
    given = {name for found in re.finditer(names, script) for name in found.groups() if name}
    assert declared
    assert given == declared - HARMONICS
