"""Body files: synthetic ones of every kind against slow loops over the raw arrays, and wrong ones
of every kind."""

from __future__ import annotations

import inspect
import re
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import tiny_body
from synthetic_bodies import (
    NUM_JOINTS,
    Arrays,
    M,
    T,
    model,
    parents_of,
    slow_vertices,
    write_npz,
    write_obj,
    write_pickle,
    write_python2_pickle,
)

from dyngs.core.errors import DyngsError
from dyngs.data.capture import BodyFrames, ShapeSpace
from dyngs.human.body.body import BodyTemplate, apply_shape, posed_vertices
from dyngs.human.body.body_reader import (
    default_template,
    load_template,
    read_body,
    rest_shape,
)
from dyngs.human.keys import HumanModel

TEMPLATE = Path(inspect.getfile(BodyTemplate)).parent / "files" / "anny_smplx55.npz"


def assert_same(body: BodyTemplate, arrays: Arrays) -> None:
    """Assert that the loaded body is posed like the raw arrays, in float32 and float64, to a
    micrometre."""
    generator = np.random.default_rng(1)
    count = arrays["shapedirs"].shape[2]
    poses = 0.5 * generator.standard_normal((2, len(body.joints), 3))
    trans = generator.standard_normal((2, 3))
    beta = generator.standard_normal(count)
    expected = slow_vertices(arrays, poses, trans, beta)
    shapes = body.num_shapes
    assert shapes == count
    for dtype in (torch.float32, torch.float64):
        given = (torch.from_numpy(x).to(dtype) for x in (poses, trans, beta))
        found = posed_vertices(body.to(dtype=dtype), *given)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.fixture
def chumpy(monkeypatch: pytest.MonkeyPatch) -> Callable[[object], object]:
    """Wraps an array as chumpy does; its class can be named in pickles but is gone when they are
    read."""

    class Ch:
        def __init__(self, x: object) -> None:
            self.x = x
            self.dterms = ("x",)

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return Ch


def refusal(path: Path, uv: Path | None = None) -> str:
    """The one line that a wrong file ends in; it names the file."""
    with pytest.raises(DyngsError) as caught:
        read_body(path, uv)
    message = str(caught.value)
    assert "\n" not in message
    assert str(uv or path) in message
    return message


# --- right files
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", NUM_JOINTS)
def test_an_npz_body_is_posed_as_in_the_paper(kind: str, tmp_path: Path) -> None:
    arrays = model(kind)
    body = read_body(write_npz(tmp_path / "model.npz", arrays))
    assert body.name == kind
    assert body.parents == tuple(parents_of(kind))
    np.testing.assert_array_equal(body.faces, arrays["f"].astype(np.int64))
    assert body.vertices.dtype == torch.float32
    assert_same(body, arrays)


@pytest.mark.parametrize("kind", NUM_JOINTS)
@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_is_the_same_as_an_npz(kind: str, protocol: int, tmp_path: Path) -> None:
    """With a sparse regressor, arrays of another memory order, and a class beside them that is of
    no use."""
    arrays = model(kind)
    whole = read_body(write_npz(tmp_path / "model.npz", arrays))
    changed = arrays | {
        "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
        "posedirs": np.asfortranarray(arrays["posedirs"]),
        "v_template": arrays["v_template"].T.copy().T,
        "shapedirs": arrays["shapedirs"].transpose(1, 0, 2).copy().transpose(1, 0, 2),
        "weights": arrays["weights"].astype(">f8"),
        "joint2num": np.array({"Pelvis": 0}, dtype=object),
        "weights_prior": np.zeros(0),
        "sex": np.float64(1),
    }
    assert_equal(read_body(write_pickle(tmp_path / "model.pkl", changed, protocol)), whole)


def assert_equal(one: BodyTemplate, other: BodyTemplate) -> None:
    for name, value in vars(one).items():
        expected = getattr(other, name)
        assert (
            torch.equal(value, expected) if isinstance(value, torch.Tensor) else value == expected
        ), name


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_pickles_of_python_2_with_chumpy(
    chumpy: Callable[[object], object], protocol: int, tmp_path: Path
) -> None:
    """Read pickles like the original SMPL files without chumpy being installed."""
    arrays = model("smpl")
    whole = read_body(write_npz(tmp_path / "model.npz", arrays))
    old = arrays | {
        key: chumpy(arrays[key]) for key in ("v_template", "shapedirs", "posedirs", "weights")
    }
    old["J"] = chumpy(None)
    old["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    path = write_python2_pickle(tmp_path / "model.pkl", old, protocol)
    assert b"chumpy.ch" in path.read_bytes()
    assert b"numpy.core" in path.read_bytes()
    for name in ("chumpy", "chumpy.ch"):
        del sys.modules[name]
    assert_equal(read_body(path), whole)


@pytest.mark.parametrize(
    ("kind", "directions", "shapes"),
    [("smplx", 20, 10), ("smplx", 400, 300), ("smplx", 16, 16), ("smpl", 300, 300)],
)
def test_expressions_after_the_shapes_are_left_out(
    kind: str, directions: int, shapes: int, tmp_path: Path
) -> None:
    arrays = model(kind, directions=directions)
    body = read_body(write_npz(tmp_path / "model.npz", arrays))
    expected = np.asarray(arrays["shapedirs"], dtype=np.float32)[..., :shapes]
    assert body.shape_dirs is not None
    np.testing.assert_array_equal(body.shape_dirs, expected)


def test_the_template_equals_its_file() -> None:
    body = default_template()
    with np.load(TEMPLATE, allow_pickle=False) as raw:
        np.testing.assert_array_equal(body.vertices, raw["v_template"])
        np.testing.assert_array_equal(body.joints, raw["J"])
        np.testing.assert_array_equal(body.faces, raw["f"])
        np.testing.assert_array_equal(
            body.uv_faces,  # pyright: ignore[reportArgumentType]
            raw["ft"],
        )
        assert body.parents == tuple(raw["kintree_table"][0].tolist())
        for row in range(0, len(body.weights), 997):
            expected = np.zeros(55)
            for joint, fraction in zip(
                raw["weights_idx"][row], raw["weights_val"][row], strict=True
            ):
                expected[joint] += fraction
            np.testing.assert_allclose(body.weights[row], expected, rtol=0, atol=2e-7)


# --- texture coordinates
# ----------------------------------------------------------------------------------------------


def textured() -> tuple[Arrays, np.ndarray, np.ndarray]:
    """A body, texture coordinates, and the triangles into those, other in number than the
    vertices."""
    arrays = model("smpl")
    generator = np.random.default_rng(0)
    return arrays, generator.uniform(0, 1, (M + 7, 2)), generator.integers(0, M + 7, (T, 3))


def test_uvs_of_the_file_belong_to_corners(tmp_path: Path) -> None:
    arrays = model("smplx")
    body = read_body(write_npz(tmp_path / "model.npz", arrays))
    assert body.uv is not None
    assert body.uv_faces is not None
    np.testing.assert_array_equal(body.uv_faces, arrays["ft"].astype(np.int64))
    np.testing.assert_allclose(body.uv, arrays["vt"], atol=1e-7)
    assert read_body(write_npz(tmp_path / "other.npz", model("smpl"))).uv is None


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_uvs_of_an_obj_belong_to_corners_in_any_order(seed: int) -> None:
    """Triangles in another order that begin at another corner or run the other way: each corner
    keeps its own."""
    arrays, uv, uv_faces = textured()
    faces = arrays["f"].astype(np.int64)
    generator = np.random.default_rng(seed)
    order = generator.permutation(T)
    corners = generator.permuted(np.tile(np.arange(3), (T, 1)), axis=1)
    one = np.take_along_axis(faces[order], corners, 1)
    other = np.take_along_axis(uv_faces[order], corners, 1)
    file = write_npz(Path("model.npz"), arrays)
    obj = write_obj(Path("uv.obj"), one, uv, other)
    body = read_body(file, obj)
    assert body.uv is not None
    assert body.uv_faces is not None
    np.testing.assert_array_equal(body.uv_faces, uv_faces)
    np.testing.assert_allclose(body.uv, uv, atol=1e-7)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("f ", "# ", "give the .obj made for this body"),
        ("f ", "f 1 2 3\n# ", "cannot be read"),
        ("f ", "f 1//1 2//1 3//1\n# ", "cannot be read"),
        ("f ", "f 1/99 2/1 3/1\n# ", "cannot be read|does not exist"),
        ("vt 0.", "vt 7.", r"must lie in \[0, 1\]"),
        ("vt 0.", "vt nan#", "could not convert"),
        ("vt 0.", "vt nan 0.", r"must lie in \[0, 1\]"),
        ("vt ", "# ", "does not exist"),
    ],
)
def test_wrong_objs(old: str, new: str, words: str, tmp_path: Path) -> None:
    arrays, uv, uv_faces = textured()
    file = write_npz(tmp_path / "model.npz", arrays)
    obj = write_obj(tmp_path / "uv.obj", arrays["f"].astype(np.int64), uv, uv_faces)
    text = obj.read_text()
    text = text.replace(old, new) if old == "vt " else text.replace(old, new, 1)
    obj.write_text(text)
    assert re.search(words, refusal(file, obj))


# --- wrong files
# ----------------------------------------------------------------------------------------------


def changed(key: str, change: Callable[[np.ndarray], object], kind: str = "smpl") -> Arrays:
    arrays = model(kind)
    return arrays | {key: change(np.array(arrays[key]))}


def with_entry(value: np.ndarray, where: tuple[int, ...], entry: float | list[float]) -> np.ndarray:
    value[where] = entry
    return value


def with_parents(change: dict[int, int]) -> Arrays:
    def table(value: np.ndarray) -> np.ndarray:
        value = value.astype(np.int64)
        for joint, parent in change.items():
            value[0, joint] = parent
        return value

    return changed("kintree_table", table)


WRONG: dict[str, tuple[Arrays, str]] = {
    "cycle": (with_parents({4: 7, 7: 4}), "parents before"),
    "two roots": (with_parents({5: -1}), "parents before"),
    "numbering": (
        changed("kintree_table", lambda x: with_entry(x, (1, 4), 5)),
        "must number joints",
    ),
    "joints": (changed("kintree_table", lambda x: x[:, :23]), "has 23 joints; SMPL has 24"),
    "weights": (
        changed("weights", lambda x: with_entry(x, (3, 0), 2)),
        "must be non-negative and sum to 1",
    ),
    "negative": (
        changed("weights", lambda x: with_entry(x, (3,), [1.5, -0.5] + [0] * 22)),
        "must be non-negative and sum to 1",
    ),
    "shape": (
        changed("weights", lambda x: x[:-1]),
        "'weights' must have shape 30 x 24, got 29 x 24",
    ),
    "no vertices": (
        changed("v_template", lambda x: x[:0]),
        "'v_template' must have shape n x 3, got 0 x 3",
    ),
    "other kind": (
        changed("posedirs", lambda x: x[..., :99]),
        "'posedirs' must have shape 30 x 3 x 207, got 30 x 3 x 99",
    ),
    "NaN": (
        changed("v_template", lambda x: with_entry(x, (4, 1), np.nan)),
        "'v_template' holds NaN",
    ),
    "faces": (
        changed("f", lambda x: with_entry(x, (4, 1), M)),
        "'f' must hold integers from 0 to 29",
    ),
    "fractions": (changed("f", lambda x: x + 0.5), "'f' must hold integers"),
    "text": (
        changed("v_template", lambda _: np.array("no")),
        "'v_template' must hold numbers, not <U2",
    ),
    "uv": (changed("vt", lambda x: x + 0.5, "smplx"), "UV coordinates must lie in"),
    "half a uv": ({k: v for k, v in model("smplx").items() if k != "ft"}, "'ft'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arrays_are_named(case: str, tmp_path: Path) -> None:
    arrays, words = WRONG[case]
    with pytest.raises(DyngsError, match=words):
        read_body(write_npz(tmp_path / "model.npz", arrays))
    refusal(tmp_path / "model.npz")


@pytest.mark.parametrize(
    "key", ["v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs", "posedirs"]
)
def test_missing_keys_are_named(key: str, tmp_path: Path) -> None:
    arrays = {name: value for name, value in model("smpl").items() if name != key}
    words = f"cannot be read .*'{key}'.*; give a body file of SMPL, SMPL-H or SMPL-X"
    assert re.search(words, refusal(write_npz(tmp_path / "model.npz", arrays)))
    assert re.search(words, refusal(write_pickle(tmp_path / "model.pkl", arrays)))


def test_files_that_are_no_body_files(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "none.npz")
    assert "no such file" in refusal(tmp_path / "none.pkl")
    assert "must end in .npz or .pkl" in refusal(tmp_path)
    (tmp_path / "model.fbx").touch()
    assert "must end in .npz or .pkl" in refusal(tmp_path / "model.fbx")
    for name, words in (("empty.npz", "damaged"), ("empty.pkl", "it must be a pickle")):
        (tmp_path / name).touch()
        assert words in refusal(tmp_path / name)
    assert "give a body file" in refusal(write_pickle(tmp_path / "list.pkl", [1, 2]))
    np.save(tmp_path / "one.npy", np.zeros(3))
    assert "not a .npz" in refusal((tmp_path / "one.npy").rename(tmp_path / "one.npz"))


# --- files that want to run code
# -------------------------------------------------------------------------------------


def test_files_are_read_again_only_when_they_have_changed(tmp_path: Path) -> None:
    named = HumanModel(body=write_npz(tmp_path / "x.npz", model("smpl", seed=1)))
    first = load_template(named)
    assert load_template(named) is first
    write_npz(tmp_path / "x.npz", model("smpl", seed=2))
    assert not torch.equal(load_template(named).vertices, first.vertices)


def parameters(betas: torch.Tensor, shape_space: ShapeSpace) -> BodyFrames:
    row = np.zeros((1, 3))
    return BodyFrames(
        (0,), np.zeros((1, 55, 3)), row, betas.numpy(), np.ones(1), shape_space=shape_space
    )


def test_shape_parameters_count_in_their_own_shape_space_only() -> None:
    betas = torch.tensor([0.5, -1.0, 3.0])
    free = default_template()
    other = tiny_body(shapes=2)
    assert torch.equal(rest_shape(free, parameters(betas, "smpl"))[0], free.vertices)
    assert torch.equal(rest_shape(other, parameters(betas, "anny"))[1], other.joints)
    assert torch.equal(rest_shape(free, parameters(betas, "anny"))[1], apply_shape(free, betas)[1])


def test_a_fingerprint_tells_files_apart_by_mesh_shapes_and_joints(tmp_path: Path) -> None:
    arrays = model("smpl")
    body = read_body(write_npz(tmp_path / "a.npz", arrays))
    again = read_body(write_pickle(tmp_path / "a.pkl", arrays))
    assert again.fingerprint == body.fingerprint, "whatever kind of file it is"
    more = np.concatenate([arrays["shapedirs"], arrays["shapedirs"]], axis=2)
    longer = read_body(write_npz(tmp_path / "b.npz", arrays | {"shapedirs": more}))
    assert longer.fingerprint == body.fingerprint, "only ten shapes are fitted"
    others = [replace(body, name="smplh")] + [
        read_body(write_npz(tmp_path / f"{key}.npz", arrays | {key: 1.01 * arrays[key]}))
        for key in ("v_template", "shapedirs")
    ]
    assert len({x.fingerprint for x in (body, *others)}) == 4
