"""Body parameters, silhouettes, and files that may be damaged."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from measured import cost_of
from scipy.spatial.transform import Rotation
from tiny_captures import random_pixels, write_picture

from dyngs.data.capture import View
from dyngs.data.readers.people import (
    BodyFrames,
    Silhouette,
    about_pelvis,
    body_frames,
    cut_out,
    hdf5_length,
    moved,
    numbers_of,
    person_view,
    read_hdf5,
    read_npz,
    rows_of,
    some,
)
from dyngs.errors import DyngsError

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
FILE = Path("body.npz")


def posed(points: np.ndarray, joints: np.ndarray, weights: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(M, 3) linear blend skinning, one joint after the other: ``v = sum_j w_j A_j v``."""
    to_world: list[np.ndarray] = []
    total = np.zeros_like(points)
    for joint, parent in enumerate(PARENTS):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(pose[joint]).as_matrix()
        step[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        to_world.append(step if parent < 0 else to_world[parent] @ step)
        turned = (points - joints[joint]) @ to_world[joint][:3, :3].T + to_world[joint][:3, 3]
        total += weights[:, joint, None] * turned
    return total


def random_body(seed: int, count: int = 3, turned: bool = True) -> BodyFrames:
    rng = np.random.default_rng(seed)
    return BodyFrames(
        frames=tuple(range(count)),
        poses=rng.normal(size=(count, 24, 3)),
        trans=rng.normal(size=(count, 3)),
        betas=np.zeros(10),
        scale=rng.uniform(0.2, 3, count),
        turns=rng.normal(size=(count, 3)) * 2 if turned else None,
    )


def in_world(body: BodyFrames, row: int, points: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Where the points of a template are, as ``BodyFrames`` says it."""
    at_rest = posed(points, joints, weights, body.poses[row])
    if body.turns is not None:
        at_rest = at_rest @ Rotation.from_rotvec(body.turns[row]).as_matrix().T
    return body.scale[row] * at_rest + body.trans[row]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_turns_about_the_origin_become_turns_about_the_pelvis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, joints, weights = rng.normal(size=(8, 3)), rng.normal(size=(24, 3)), rng.dirichlet(np.ones(24), 8)
    body = random_body(seed)
    same = about_pelvis(body, joints[0])
    assert same.turns is None
    for row in range(3):
        expected = in_world(body, row, points, joints, weights)
        np.testing.assert_allclose(in_world(same, row, points, joints, weights), expected, atol=1e-11)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_another_template_has_its_pelvis_where_the_fitted_body_had_it(seed: int, turned: bool) -> None:
    rng = np.random.default_rng(seed)
    fitted, own = rng.normal(size=(2, 3))
    body = replace(random_body(seed, turned=turned), pelvis=fitted)
    other = about_pelvis(body, own)
    turns = Rotation.from_rotvec(np.zeros((3, 3)) if body.turns is None else body.turns)
    expected = body.scale[:, None] * turns.apply(fitted) + body.trans
    np.testing.assert_allclose(other.scale[:, None] * own + other.trans, expected, atol=1e-12)
    np.testing.assert_allclose(about_pelvis(other, fitted).trans, about_pelvis(body, fitted).trans, atol=1e-12)


def test_nothing_to_turn_leaves_everything_and_moves_with_the_cameras() -> None:
    body = random_body(0, turned=False)
    same = about_pelvis(body, np.array([0.1, -0.2, 0.3]))
    assert np.array_equal(same.poses, body.poses)
    assert np.array_equal(same.trans, body.trans)
    assert np.array_equal(moved(body, np.array([1e6, -2.0, 3.0])).trans, body.trans - [1e6, -2.0, 3.0])


def test_rows_in_any_order_and_shape() -> None:
    poses, trans = np.arange(3 * 165.0).reshape(3, 1, 165), np.arange(9.0).reshape(3, 1, 3)
    body = body_frames(FILE, [7, 2, 5], poses, trans, np.ones((3, 10)) * [[0], [1], [2]], 2.0, pelvis=[[1, 2, 3]])
    assert (body.frames, body.kind, body.betas.tolist(), body.scale.tolist()) == ((2, 5, 7), "smplx", [1] * 10, [2] * 3)
    assert body.poses.shape == (3, 55, 3)
    assert body.poses[:, 0, 0].tolist() == [165, 330, 0]
    assert body.trans[:, 0].tolist() == [3, 6, 0]
    assert body.pelvis is not None
    assert body.pelvis.tolist() == [1, 2, 3]
    kinds = [body_frames(FILE, [0], np.zeros((1, w)), [[0, 0, 0]], [0.0]).kind for w in (72, 156, 165)]
    assert kinds == ["smpl", "smplh", "smplx"]


GOOD: dict[str, Any] = {
    "frames": range(4),
    "poses": np.zeros((4, 72)),
    "trans": np.zeros((4, 3)),
    "betas": np.zeros(10),
    "scale": np.ones(4),
}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"poses": np.zeros((4, 87))}, "'poses' has 87 numbers per frame; the known bodies have 72"),
        ({"poses": np.zeros((4, 73))}, "'poses' has 73 numbers per frame"),
        ({"poses": np.zeros((3, 72))}, "'poses' has 3 rows for 4 frames"),
        ({"poses": np.zeros(())}, "'poses' has 1 rows for 4 frames"),
        ({"poses": [[0.0] * 72] * 3 + [[0.0]]}, "'poses' must hold as many numbers"),
        ({"poses": [["a"] * 72] * 4}, "'poses' must hold as many numbers"),
        ({"poses": None}, "'poses' must hold as many numbers"),
        ({"trans": np.zeros((5, 3))}, "'trans' has 5 rows for 4 frames"),
        ({"trans": np.zeros((4, 4))}, "'trans' has 4 numbers per frame instead of 3"),
        ({"trans": np.full((4, 3), np.nan)}, "'trans' of frame 0 holds NaN"),
        ({"poses": np.where(np.arange(4)[:, None] == 2, np.inf, np.zeros(72))}, "'poses' of frame 2 holds NaN"),
        ({"betas": [0, np.nan]}, "'betas' must hold finite numbers"),
        ({"betas": np.zeros((3, 10))}, "'betas' has 3 rows for 4 frames"),
        ({"scale": 0.0}, "'scale' must be positive"),
        ({"scale": -np.ones(4)}, "'scale' must be positive"),
        ({"scale": "big"}, "'scale' must hold as many numbers"),
        ({"scale": np.ones(3)}, "'scale' has 3 rows"),
        ({"turns": np.zeros((4, 4))}, "'turns' has 4 numbers per frame instead of 3"),
        ({"pelvis": [0, 1]}, "'pelvis' must hold 3 finite numbers"),
        ({"frames": [0, 1, 2, 1]}, "frame 1 has body parameters twice"),
        ({"frames": []}, "holds no frame"),
    ],
)
def test_bad_parameters(change: dict[str, Any], line: str) -> None:
    assert body_frames(FILE, **GOOD).frames == (0, 1, 2, 3)
    with pytest.raises(DyngsError, match=line) as caught:
        body_frames(FILE, **{**GOOD, **change})
    assert "body.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


def view_of(frame: int | None) -> View:
    return View(f"v{frame}", Path(f"{frame}.png"), np.eye(4), np.eye(3), 4, 3, frame=frame)


def test_views_find_their_rows_by_frame() -> None:
    body = replace(random_body(0), frames=(2, 5, 9))
    assert rows_of(FILE, body, [view_of(9), view_of(2), view_of(9)]).tolist() == [2, 0, 2]
    with pytest.raises(DyngsError, match=r"2 frames that have pictures \(3, 4\).* 3 frames from 2 to 9"):
        rows_of(FILE, body, [view_of(2), view_of(4), view_of(3), view_of(4)])
    with pytest.raises(DyngsError, match=r"None\.png has no frame number"):
        rows_of(FILE, body, [view_of(None)])


def test_some() -> None:
    assert (some([1, 2]), some(range(7))) == ("1, 2", "0, 1, 2, 3, 4 and 2 more")


def test_numbers_in_another_shape() -> None:
    assert numbers_of("f", [[[1], [2]]], (2,)).tolist() == [1, 2]
    for value in ([1, 2, 3], "ab", [[1], [2, 3]], None, [1, np.inf], [True, {}]):
        with pytest.raises(DyngsError, match="f must hold 2 finite numbers"):
            numbers_of("f", value, (2,))


@pytest.mark.parametrize(
    ("person", "expected"),
    [("white", [0, 1, 128, 255]), ("black", [255, 254, 127, 0]), ("nonzero", [0, 255, 255, 255])],
)
def test_silhouettes_become_alpha(tmp_path: Path, person: Any, expected: list[int]) -> None:
    write_picture(tmp_path / "m.png", np.array([[[0], [1], [128], [255]]], np.uint8))
    pixels = torch.from_numpy(random_pixels(1, 4, 3))
    cut = cut_out(pixels, Silhouette(tmp_path / "m.png", person))
    assert cut[0, :, 3].tolist() == expected
    assert torch.equal(cut[..., :3], pixels)


def test_silhouettes_and_alpha_multiply(tmp_path: Path) -> None:
    write_picture(tmp_path / "m.png", np.array([[[0], [128], [255]]], np.uint8))
    pixels = torch.tensor([[[9, 9, 9, 200]] * 3], dtype=torch.uint8)
    assert cut_out(pixels, Silhouette(tmp_path / "m.png", "white"))[0, :, 3].tolist() == [0, 100, 200]


def test_bad_silhouettes(tmp_path: Path) -> None:
    write_picture(tmp_path / "m.png", np.zeros((2, 3, 1), np.uint8))
    with pytest.raises(DyngsError, match=r"m\.png: the mask is 3x2 but its picture is 4x1"):
        cut_out(torch.zeros(1, 4, 3, dtype=torch.uint8), Silhouette(tmp_path / "m.png", "white"))
    with pytest.raises(DyngsError, match=r"n\.png: no such picture"):
        cut_out(torch.zeros(1, 4, 3, dtype=torch.uint8), Silhouette(tmp_path / "n.png", "white"))


def test_a_view_with_a_silhouette_stays_a_view() -> None:
    view = person_view(view_of(3), Silhouette(Path("m.png"), "white"))
    assert isinstance(view, View)
    changed = replace(view, time=0.5)
    assert (changed.silhouette, changed.frame, changed.name) == (view.silhouette, 3, "v3")
    assert person_view(view, None).silhouette is None


@pytest.fixture
def hdf5(tmp_path: Path) -> Path:
    h5py = pytest.importorskip("h5py", reason="needs dyngs[people]")
    with h5py.File(tmp_path / "m.hdf5", "w") as file:
        masks = np.zeros((5, 2, 3), np.uint8)
        masks[3, 1, 2] = 1
        file.create_dataset("masks", data=masks, compression="lzf")
        file.create_dataset("deep", data=np.zeros((2, 2, 3)))
        file.create_group("group")
    return tmp_path / "m.hdf5"


def test_silhouettes_in_hdf5(hdf5: Path) -> None:
    pixels = torch.zeros(2, 3, 3, dtype=torch.uint8)
    assert cut_out(pixels, Silhouette(hdf5, "nonzero", 3))[..., 3].tolist() == [[0, 0, 0], [0, 0, 255]]
    assert (hdf5_length(hdf5, "masks"), read_hdf5(hdf5, "masks").shape) == (5, (5, 2, 3))
    with pytest.raises(DyngsError, match="'masks' must be a data set in an HDF5 file"):
        cut_out(pixels, Silhouette(hdf5, "nonzero", 5))


def test_bad_hdf5(hdf5: Path) -> None:
    for key in ("pose", "group"):
        with pytest.raises(DyngsError, match=f"the data set '{key}' is missing"):
            read_hdf5(hdf5, key)
    with pytest.raises(DyngsError, match="no such file"):
        read_hdf5(hdf5.with_name("n.hdf5"), "masks")
    hdf5.write_bytes(hdf5.read_bytes()[:100])
    with pytest.raises(DyngsError, match="must be a data set in an HDF5 file") as caught:
        read_hdf5(hdf5, "masks")
    assert "\n" not in str(caught.value)


def test_hdf5_that_asks_for_much_or_lies_elsewhere(tmp_path: Path) -> None:
    """A data set of 800 GB, of which nothing is there; one in another file; one of texts; a link."""
    h5py: Any = pytest.importorskip("h5py")
    path = tmp_path / "m.hdf5"
    (tmp_path / "other").write_bytes(bytes(800))
    with h5py.File(path, "w") as file:
        file.create_dataset("huge", shape=(10**9, 100), chunks=(1000, 100), dtype="u1")
        file.create_dataset("wide", shape=(2, 10**9), chunks=(1, 1000), dtype="u1")
        file.create_dataset("other", shape=(100,), dtype="f8", external=[(str(tmp_path / "other"), 0, 800)])
        file.create_dataset("text", data=["a", "b"])
        file["linked"] = h5py.ExternalLink("n.hdf5", "huge")
    lines = {
        "huge": "data.max_megapixels is",
        "other": "'other' is missing",
        "text": "'text' must hold numbers",
        "linked": "'linked' is missing",
    }
    for key, line in lines.items():
        with pytest.raises(DyngsError, match=line):
            read_hdf5(path, key)
    with pytest.raises(DyngsError, match=r"data\.max_megapixels is"):
        read_hdf5(path, "wide", 1)
    assert hdf5_length(path, "huge") == 10**9


def test_texts_among_numbers(tmp_path: Path) -> None:
    """NumPy would make each as long as the longest."""
    shared: Any = [1.0] * 1000
    shared[0] = "a" * 1_000_000

    def read() -> None:
        with pytest.raises(DyngsError, match="must hold"):
            numbers_of("x", [shared, shared], None)

    assert cost_of(read)[0] < 1e6


def test_without_h5py_the_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DyngsError, match=r"x\.hdf5: HDF5 files need .* pip install 'dyngs\[people\]'"):
        read_hdf5(tmp_path / "x.hdf5", "masks")


def test_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(DyngsError, match=r"a\.npz: no such file; it should hold the body parameters poses, trans"):
        read_npz(path, ("poses", "trans"))
    np.savez(path, poses=np.zeros(3), gender="neutral")
    assert set(read_npz(path, ("poses",), ("gender", "scale"))) == {"poses", "gender"}
    with pytest.raises(DyngsError, match="'trans' is missing"):
        read_npz(path, ("poses", "trans"))
    np.savez(path, poses=np.array([{}]))
    with pytest.raises(DyngsError, match=r"a\.npz: 'poses' is not an array of numbers .*it holds Python objects"):
        read_npz(path, ("poses",))
    np.save(tmp_path / "b.npy", np.zeros(3))
    for damaged in (b"", b"PK\x03\x04", b"\x80\x04N.", (tmp_path / "b.npy").read_bytes()):
        path.write_bytes(damaged)
        with pytest.raises(DyngsError, match=r"a\.npz: cannot be read") as caught:
            read_npz(path, ("poses",))
        assert "\n" not in str(caught.value)


def test_hdf5_that_leads_to_another_file(hdf5: Path) -> None:
    """By a link, a virtual data set or external storage: none is followed."""
    h5py = pytest.importorskip("h5py")
    private = hdf5.with_name("private.bin")
    private.write_bytes(bytes(range(6)))
    with h5py.File(hdf5, "a") as file:
        file["linked"] = h5py.ExternalLink("m2.hdf5", "masks")
        file["soft"] = h5py.SoftLink("/linked")
        file.create_dataset("outside", (1, 2, 3), np.uint8, external=[(str(private), 0, 6)])
        layout = h5py.VirtualLayout((5, 2, 3), np.uint8)
        layout[:] = h5py.VirtualSource("m2.hdf5", "masks", (5, 2, 3))
        file.create_virtual_dataset("virtual", layout)
    hdf5.with_name("m2.hdf5").write_bytes(hdf5.read_bytes())
    for key in ("linked", "soft", "outside", "virtual"):
        with pytest.raises(DyngsError, match=f"the data set '{key}' is missing"):
            read_hdf5(hdf5, key)


def test_hdf5_that_would_fill_the_memory(hdf5: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(hdf5, "a") as file:
        file.create_dataset("empty", (10**6, 10**6), np.float32)
        file.create_dataset("row", (2, 10**5, 10**5), np.uint8, chunks=(1, 1000, 1000), compression="gzip")
        file.create_dataset("chunk", (200, 1000, 1000), np.uint8, chunks=(200, 1000, 1000), compression="gzip")
    for key, rows in (("empty", ...), ("row", 0), ("chunk", 0)):
        with pytest.raises(DyngsError, match=r"m\.hdf5: .*data\.max_megapixels is 150"):
            read_hdf5(hdf5, key, rows)
    assert hdf5_length(hdf5, "empty") == 10**6


def test_damaged_hdf5_is_read_or_refused_in_one_line(hdf5: Path) -> None:
    data, lines = hdf5.read_bytes(), []
    for seed in range(300):
        rng, changed = np.random.default_rng(seed), bytearray(data)
        for _ in range(rng.choice([1, 4, 16])):
            changed[int(rng.integers(len(changed)))] = rng.integers(256)
        hdf5.write_bytes(changed)
        try:
            read_hdf5(hdf5, "masks", 3)
        except DyngsError as error:
            lines.append(str(error))
    assert [line for line in lines if str(hdf5) not in line or "\n" in line] == []
