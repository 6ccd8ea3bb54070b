"""The file: what was stored comes back, again and again, and anything else is one line."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from dyngs.core.errors import DyngsError
from dyngs.core.state import select_prefix
from dyngs.gaussians import Gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.models.checkpoint import CheckpointInfo
from dyngs.runs.stored_file import (
    COARSENESS,
    MAGIC,
    MAX_HEADER,
    compress_lzma,
    decode_scene,
    decompress_lzma,
    encode_scene,
    pack_integers,
    read_scene,
    unpack_integers,
    write_scene,
)

INFO = CheckpointInfo(7, 2.5, (1e6 + 0.25, 0.0, -3.0), "white", "classic")
STEPS = {
    "means": 0.01,
    "quats": 0.01,
    "log_scales": 0.02,
    "logit_opacities": 0.004,
    "sh_base": 0.02,
    "sh_rest": 0.05,
}
STEPS = {f"gaussians.{name}": step for name, step in STEPS.items()}
EXTREMES = st.sampled_from((0.0, 1.0, -1e4, 1e30, -1e30, 88.0)) | st.floats(-3, 3, width=32)


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, torch.Tensor]:
    """Tensors of 0 to 5 Gaussians of any degree, some values extreme."""
    n = draw(st.integers(0, 5))
    degree = draw(st.integers(0, 4))
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
    shapes["sh"] = (n, (degree + 1) ** 2, 3)
    tensors = {}
    for name, shape in shapes.items():
        pool = draw(st.lists(EXTREMES, min_size=1, max_size=12))
        count = int(torch.tensor(shape).prod())
        tensors[f"gaussians.{name}"] = torch.tensor((pool * count)[:count]).reshape(shape)
    if draw(st.booleans()):
        tensors[COARSENESS] = torch.arange(n, dtype=torch.uint8)
    return tensors


def small_scene(count: int = 3) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (4, 3)}
    return {
        f"gaussians.{name}": torch.randn(count, *shape, generator=generator)
        for name, shape in shapes.items()
    }


def stored(tensors: dict[str, torch.Tensor], steps: Mapping[str, float] = STEPS) -> bytes:
    """The file of a static scene."""
    own = {name: x for name, x in tensors.items() if name != COARSENESS}
    scene = StaticScene(gaussians=Gaussians(**select_prefix(own, "gaussians")))
    return encode_scene(INFO, scene, steps, tensors.get(COARSENESS))


def with_header(data: bytes, old: bytes, new: bytes) -> bytes:
    """The file with ``old`` replaced in its header, and a checksum that fits."""
    start = len(MAGIC) + 4
    end = start + int.from_bytes(data[len(MAGIC) : start], "little")
    header = decompress_lzma(data[start:end], MAX_HEADER, exact=False)
    assert old in header
    changed = compress_lzma(header.replace(old, new, 1), room=MAX_HEADER)
    body = MAGIC + len(changed).to_bytes(4, "little") + changed + data[end:-32]
    return body + hashlib.sha256(body).digest()


@given(scenes())
@settings(deadline=None, max_examples=25)
def test_stored_again_it_is_the_same_file(tensors: dict[str, torch.Tensor]) -> None:
    data = stored(tensors)
    found = decode_scene(data)
    assert found.info == INFO
    for name, x in tensors.items():
        assert found.tensors[name].shape == x.shape
        assert found.tensors[name].dtype == x.dtype
        assert torch.isfinite(found.tensors[name].double()).all()
    assert stored(found.tensors) == data


def test_values_come_back_within_their_steps() -> None:
    tensors = small_scene(200)
    found = decode_scene(stored(tensors)).tensors
    order = [
        int((tensors["gaussians.means"] - mean).abs().sum(1).argmin())
        for mean in found["gaussians.means"]
    ]
    assert sorted(order) == list(range(200))
    for name, tolerance in (("means", 0.005), ("sh", 0.033)):
        # half a step; 0.65 of one where zero is preferred
        error = (found[f"gaussians.{name}"] - tensors[f"gaussians.{name}"][order]).abs().max()
        assert error <= tolerance + 1e-6


def test_every_cut_and_every_flip_is_an_error(tmp_path: Path) -> None:
    data = stored(small_scene())
    for end in range(len(data)):
        with pytest.raises(DyngsError) as caught:
            decode_scene(data[:end])
        assert "\n" not in str(caught.value)
    for place in range(len(data)):
        with pytest.raises(DyngsError):
            decode_scene(data[:place] + bytes([data[place] ^ (1 << place % 8)]) + data[place + 1 :])
    path = tmp_path / "scene.dyngs"
    write_scene(path, data[:-1])
    with pytest.raises(DyngsError, match=r"scene.dyngs: damaged or cut off"):
        read_scene(path)
    with pytest.raises(DyngsError, match="cannot be read"):
        read_scene(tmp_path / "none.dyngs")


@given(st.data())
@settings(deadline=None, max_examples=30)
def test_a_forged_file_is_an_error_or_a_scene(source: st.DataObject) -> None:
    """Flip bytes under a valid checksum: decoding returns a scene or raises a one-line error."""
    data = bytearray(stored(small_scene())[:-32])
    for _ in range(source.draw(st.integers(1, 4))):
        data[source.draw(st.integers(len(MAGIC), len(data) - 1))] ^= source.draw(
            st.integers(1, 255)
        )
    told = None
    try:
        found = decode_scene(bytes(data) + hashlib.sha256(data).digest())
    except DyngsError as error:
        told = str(error)
    assert "\n" not in told if told is not None else len(found.tensors["gaussians.sh"]) == 3


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b'"shape":[3,3]', b'"shape":[900000000000,3]', "too many"),
        (b'"shape":[3,3]', b'"shape":[2,3]', "another length than stated"),
        (b'"shape":[3,3]', b'"shape":[-3,3]', "contents are wrong"),
        (b'"kind":"rotation"', b'"kind":"python"', "contents are wrong"),
        (b'"dtype":"float32"', b'"dtype":"object"', "contents are wrong"),
        (b'"planes":1', b'"planes":9', "contents are wrong"),
        (b'"far":0', b'"far":99999', "contents are wrong|does not match"),
        (b'"name":"gaussians.means"', b'"name":"gaussians.meals"', "missing|wrong"),
        (b'"extent":2.5', b'"extent":NaN', "contents are wrong"),
    ],
)
def test_a_forged_header_is_refused(old: bytes, new: bytes, said: str) -> None:
    data = stored(small_scene())
    with pytest.raises(DyngsError, match=said):
        decode_scene(with_header(data, old, new))


def test_other_versions_and_other_files_are_told_apart() -> None:
    data = stored(small_scene())
    with pytest.raises(DyngsError, match="another version"):
        decode_scene(data[:6] + b"\x02" + data[7:])
    with pytest.raises(DyngsError, match="not a stored scene"):
        decode_scene(b"ply\nformat binary_little_endian 1.0\n")


ARRAYS = nps.arrays(
    np.int64,
    nps.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6),
    elements=st.integers(-(2**63), 2**63 - 1) | st.integers(-3, 3),
)


@given(ARRAYS)
@settings(deadline=None, max_examples=40)
def test_numbers_come_back(whole: np.ndarray) -> None:
    packing, data = pack_integers(whole)
    back = unpack_integers(packing, data, whole.shape)
    assert back.dtype == np.int64
    assert np.array_equal(back, whole)


@pytest.mark.parametrize("size", [0, 9, 11])
def test_another_length_is_an_error(size: int) -> None:
    with pytest.raises(DyngsError, match="another length than stated"):
        decompress_lzma(compress_lzma(b"0123456789"), size)
