"""The .ply reader and writer: round trips, files of other programs, damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from measured import cost_of

from dyngs.core.conventions import RasterizeMode, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.ply import write_ply
from dyngs.io.formats.splat_file import SplatFile

PLAYBOT = Path(__file__).parents[3] / "../shared/data/splats/playbot_125k_sh2.ply"


def make_gaussians(count: int, degree: int, seed: int = 0) -> Gaussians:
    """Random Gaussians with unit quaternions."""
    random = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    quats = torch.nn.functional.normalize(normal(count, 4), dim=1)
    return Gaussians(
        normal(count, 3),
        quats,
        normal(count, 3),
        normal(count),
        normal(count, num_sh_terms(degree), 3),
    )


def written(path: Path, gaussians: Gaussians) -> Path:
    return write_splats(path, SplatFile(gaussians)).path


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name, x in a.tensors().items():
        torch.testing.assert_close(b.tensors()[name], x, rtol=0, atol=0)


def write_vertices(
    path: Path, columns: dict[str, np.ndarray], fmt: str = "binary_little_endian"
) -> Path:
    """A .ply written by hand from named columns, each of its own dtype."""
    kinds = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {fmt} 1.0", f"element vertex {count}"]
    lines += [f"property {kinds[x.dtype.str[1:]]} {name}" for name, x in columns.items()]
    order = ">" if fmt == "binary_big_endian" else "<"
    rows = np.empty(count, dtype=[(name, order + x.dtype.str[1:]) for name, x in columns.items()])
    for name, x in columns.items():
        rows[name] = x
    text = "".join(" ".join(repr(v.item()) for v in row) + "\n" for row in rows).encode()
    path.write_bytes(
        "\n".join([*lines, "end_header\n"]).encode() + (text if fmt == "ascii" else rows.tobytes())
    )
    return path


def plain_columns(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Columns of a file without normals, in the order of the paper's layout."""
    table = {"x": 0, "y": 1, "z": 2}
    columns = {name: gaussians.means[:, i].numpy() for name, i in table.items()}
    columns |= {f"f_dc_{i}": gaussians.sh[:, 0, i].numpy() for i in range(3)}
    rest = gaussians.sh[:, 1:].transpose(1, 2).reshape(len(gaussians), -1)
    columns |= {f"f_rest_{i}": rest[:, i].numpy() for i in range(rest.shape[1])}
    columns |= {"opacity": gaussians.logit_opacities.numpy()}
    columns |= {f"scale_{i}": gaussians.log_scales[:, i].numpy() for i in range(3)}
    return columns | {f"rot_{i}": gaussians.quats[:, i].numpy() for i in range(4)}


@settings(max_examples=20, deadline=None)
@given(
    count=st.integers(1, 20),
    degree=st.integers(0, 4),
    mode=st.sampled_from(RasterizeMode),
    seed=st.integers(0, 2**31),
    offset=st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    eps2d=st.none() | st.floats(0, 1),
)
def test_round_trip_keeps_everything(
    tmp_path_factory, count, degree, mode, seed, offset, eps2d
) -> None:
    gaussians = make_gaussians(count, degree, seed)
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_splats(path, SplatFile(gaussians, mode, eps2d, offset, ("made in a test",)))
    back = read_splats(path)
    assert_same(gaussians, back.gaussians)
    assert (back.mode, back.eps2d, back.world_offset) == (mode, eps2d, offset)
    assert "made in a test" in back.comments
    assert f"SH degree: {degree}" in back.comments


@settings(max_examples=10, deadline=None)
@given(count=st.integers(1, 8), seed=st.integers(0, 2**31))
def test_what_is_read_is_written_back_byte_for_byte(tmp_path_factory, count, seed) -> None:
    folder = tmp_path_factory.mktemp("ply")
    first = written(folder / "a.ply", make_gaussians(count, 3, seed))
    second = written(folder / "b.ply", read_splats(first).gaussians)
    assert first.read_bytes() == second.read_bytes()


def test_layout_is_that_of_3dgs_as_plyfile_reads_it(tmp_path) -> None:
    plyfile = pytest.importorskip("plyfile")
    gaussians = make_gaussians(5, 3)
    data = plyfile.PlyData.read(str(written(tmp_path / "a.ply", gaussians)))
    names = [p.name for p in data["vertex"].properties]
    rest = [f"f_rest_{i}" for i in range(45)]
    tail = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, *tail]
    assert data.byte_order == "<"
    assert {p.val_dtype for p in data["vertex"].properties} == {"f4"}
    assert data.comments[0].startswith("Generated by dyngs ")
    assert data.comments[1] == "SplatRenderMode: default"
    vertex = data["vertex"]
    np.testing.assert_array_equal(vertex["f_rest_14"], gaussians.sh[:, 15, 0])  # last red term
    np.testing.assert_array_equal(vertex["f_rest_15"], gaussians.sh[:, 1, 1])  # first green term
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats[:, 0])
    np.testing.assert_array_equal(vertex["opacity"], gaussians.logit_opacities)
    assert not vertex["nx"].any()


def test_file_of_another_program() -> None:
    if not PLAYBOT.exists():
        pytest.skip("shared/data/splats is not beside the repository")
    splats = read_splats(PLAYBOT)
    assert len(splats.gaussians) == 125_000
    assert splats.gaussians.sh_degree == 2
    assert splats.mode is RasterizeMode.CLASSIC
    assert splats.comments == ()
    np.testing.assert_allclose(splats.gaussians.quats.norm(dim=1), 1, atol=1e-6)
    plyfile = pytest.importorskip("plyfile")
    vertex = plyfile.PlyData.read(str(PLAYBOT))["vertex"]
    np.testing.assert_array_equal(splats.gaussians.sh[:, 3, 1], vertex["f_rest_10"])
    np.testing.assert_array_equal(splats.gaussians.log_scales[:, 2], vertex["scale_2"])


@settings(max_examples=20, deadline=None)
@given(data=st.data(), fmt=st.sampled_from(["binary_little_endian", "binary_big_endian", "ascii"]))
def test_any_property_order_type_and_extras(tmp_path_factory, data, fmt) -> None:
    gaussians = make_gaussians(4, data.draw(st.integers(0, 4)))
    columns = plain_columns(gaussians) | {
        "label": np.arange(4, dtype="u1"),
        "id": np.arange(4, dtype="i4"),
    }
    names = data.draw(st.permutations(sorted(columns)))
    doubles = data.draw(st.sets(st.sampled_from(names)))
    mixed = {
        name: columns[name].astype("f8") if name in doubles else columns[name] for name in names
    }
    path = write_vertices(tmp_path_factory.mktemp("ply") / "a.ply", mixed, fmt)
    assert_same(gaussians, read_splats(path).gaussians)


def test_other_elements_are_skipped(tmp_path) -> None:
    gaussians = make_gaussians(3, 0)
    header, body = written(tmp_path / "a.ply", gaussians).read_bytes().split(b"end_header\n", 1)
    header = header.replace(
        b"element vertex", b"element camera 2\nproperty double f\nproperty uchar g\nelement vertex"
    )
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "b.ply").write_bytes(header + faces + bytes(18) + body + bytes(13))
    assert_same(gaussians, read_splats(tmp_path / "b.ply").gaussians)


@pytest.mark.parametrize(
    ("comment", "mode"),
    [
        ("SplatRenderMode: mip", RasterizeMode.ANTIALIASED),
        ("SplatRenderMode: default", RasterizeMode.CLASSIC),
        ("antialiased 1", RasterizeMode.ANTIALIASED),
        ("antialiased 0", RasterizeMode.CLASSIC),
        ("Vertical axis: y", RasterizeMode.CLASSIC),
    ],
)
def test_render_mode_comments(tmp_path, comment, mode) -> None:
    path = write_vertices(tmp_path / "a.ply", plain_columns(make_gaussians(1, 0)))
    path.write_bytes(
        path.read_bytes().replace(
            b"element vertex", f"comment {comment}\r\nelement vertex".encode()
        )
    )
    assert read_splats(path).mode is mode


def test_quaternions_are_normalised(tmp_path) -> None:
    gaussians = make_gaussians(4, 0)
    scale = torch.tensor([1e-30, 1e30, 0.0, 7.0])[:, None]
    path = write_vertices(
        tmp_path / "a.ply", plain_columns(gaussians.replace(quats=gaussians.quats * scale))
    )
    back = read_splats(path).gaussians
    wanted = gaussians.quats.clone()
    wanted[2] = torch.tensor([1.0, 0, 0, 0])
    torch.testing.assert_close(back.quats, wanted, rtol=0, atol=3e-7)


def test_non_finite_values_are_refused_or_skipped(tmp_path) -> None:
    gaussians = make_gaussians(6, 1)
    columns = {name: x.copy() for name, x in plain_columns(gaussians).items()}
    columns["f_rest_8"][1] = np.nan
    columns["opacity"][4] = np.inf
    columns["rot_2"][4] = -np.inf
    path = write_vertices(tmp_path / "a.ply", columns)
    with pytest.raises(DyngsError, match=r"2 of 6 Gaussians have non-finite"):
        read_splats(path)
    assert_same(
        gaussians.select(torch.tensor([0, 2, 3, 5])), read_splats(path, nonfinite="skip").gaussians
    )
    means = gaussians.means.clone()
    means[3, 0] = torch.nan
    before = path.read_bytes()
    with pytest.raises(DyngsError, match="1 of 6 Gaussians have non-finite"):
        written(path, gaussians.replace(means=means))
    assert path.read_bytes() == before


def test_doubles_beyond_float32_are_non_finite(tmp_path) -> None:
    columns = plain_columns(make_gaussians(2, 0)) | {"x": np.array([1e300, 0.0])}
    with pytest.raises(DyngsError, match="1 of 2"):
        read_splats(write_vertices(tmp_path / "a.ply", columns))


@settings(max_examples=25, deadline=None)
@given(
    fraction=st.floats(0, 1, exclude_max=True),
    fmt=st.sampled_from(["binary_little_endian", "ascii"]),
)
def test_every_truncation_is_an_error(tmp_path_factory, fraction, fmt) -> None:
    path = write_vertices(
        tmp_path_factory.mktemp("ply") / "a.ply", plain_columns(make_gaussians(3, 1)), fmt
    )
    whole = path.read_bytes().rstrip(b"\n") if fmt == "ascii" else path.read_bytes()
    # cutting digits off the last number cannot be noticed
    last = whole.rfind(b" ") if fmt == "ascii" else len(whole)
    path.write_bytes(whole[: int(fraction * last)])
    with pytest.raises(DyngsError, match=r"a\.ply"):
        read_splats(path)


def header_of(*lines: str) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()


_NEEDED = [f"property float {name}" for name in plain_columns(make_gaussians(1, 0))]


HOSTILE = {
    "properties": (
        ["element vertex 1", *(f"property float {i:x}" for i in range(50_000))],
        "4,097 properties",
    ),
    "lists": (
        ["element vertex 1", *_NEEDED, *["property list int int a"] * 40_000],
        "list properties",
    ),
    "elements": ([f"element {i:x} 0" for i in range(60_000)], "asks for 257 elements"),
    "a comment": (
        ["comment eps2d: " + "9 " * 400_000, "element vertex 1", *_NEEDED],
        "should hold 1 finite",
    ),
    "a name": (["element vertex 1", *["property float " + "a" * 400_000] * 2], "twice"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_headers_of_a_megabyte_cost_little(tmp_path, case) -> None:
    lines, message = HOSTILE[case]
    (tmp_path / "a.ply").write_bytes(header_of(*lines) + bytes(56))

    def read() -> None:
        with pytest.raises(DyngsError, match=message) as caught:
            read_splats(tmp_path / "a.ply")
        assert len(str(caught.value)) < 600

    memory, seconds = cost_of(read)
    assert memory < 60e6
    assert seconds < 15


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a .ply"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "is not a .ply"),
        (b"ply\n", "no end_header"),
        (b"ply\n" + b"a" * 3_000_000, "no end_header|bad .ply header"),
        (b"ply\n" + b"comment x\n" * 200_000, "longer than"),
        (b"ply\nend_header\n", "names no known format"),
        (b"ply\nformat binary_middle_endian 1.0\n", "bad .ply header line 'format"),
        (header_of("element face 1", "property float x"), "no vertices"),
        (header_of("element vertex -1", *_NEEDED), "bad .ply header line 'element vertex -1'"),
        (header_of("element vertex " + "9" * 5000, *_NEEDED), "bad .ply header line"),
        (header_of("element vertex 0", *_NEEDED), "holds no Gaussians"),
        (header_of("element vertex 1", *_NEEDED, _NEEDED[0]), "property x twice"),
        (
            header_of("element vertex 1", "property half x"),
            "bad .ply header line 'property half x'",
        ),
        (header_of("element vertex 1", *_NEEDED, "property list uchar int i"), "list properties"),
        (header_of("element vertex 1", *_NEEDED[:-2]), "have no rot_2 rot_3"),
        (header_of("element vertex 1", "property uint packed_position"), "compressed"),
        (header_of("element vertex 1", *_NEEDED, "property float f_rest_0"), "f_rest properties"),
        (
            header_of("element vertex 3", *_NEEDED) + bytes(100),
            "need 168 bytes after the header, found 100",
        ),
        (header_of("element vertex 999999999999999999", *_NEEDED) + bytes(56), "is truncated"),
        (
            header_of("comment SplatRenderMode: 2dgs", "element vertex 1", *_NEEDED) + bytes(56),
            "'2dgs' is not supp",
        ),
        (
            header_of("comment world_offset: 1 2 nan", "element vertex 1", *_NEEDED) + bytes(56),
            "3 finite number",
        ),
    ],
)
def test_bad_files_end_in_one_line(tmp_path, content, message) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(DyngsError, match=message) as caught:
        read_splats(tmp_path / "bad.ply")
    assert "\n" not in str(caught.value)
    assert "bad.ply" in str(caught.value)
    assert len(str(caught.value)) < 400


def test_missing_file_and_unwritable_folder(tmp_path) -> None:
    with pytest.raises(DyngsError, match=r"none\.ply: no such file"):
        read_splats(tmp_path / "none.ply")
    (tmp_path / "file").write_text("")
    with pytest.raises(DyngsError, match="cannot write"):
        written(tmp_path / "file" / "a.ply", make_gaussians(1, 0))
    with pytest.raises(DyngsError, match="no Gaussians"):
        written(tmp_path / "a.ply", make_gaussians(0, 0))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]


def test_further_columns_are_skipped_by_our_reader(tmp_path) -> None:
    gaussians = make_gaussians(5, 1)
    column = np.arange(5)
    write_ply(tmp_path / "x.ply", SplatFile(gaussians), {"joint_0": column, "weight_0": column / 4})
    assert_same(read_splats(tmp_path / "x.ply").gaussians, gaussians)
