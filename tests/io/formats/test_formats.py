"""All formats through one reader and one writer: the same images, within what each format
rounds."""

from __future__ import annotations

import gzip
import json
import zipfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from scaled_files import FAR, scaled
from splat_scenes import cameras_turned, cloud, psnr, readable, seen

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import splat_options
from dyngs.io.containment import LIMITS_VARIABLE
from dyngs.io.formats.formats import (
    FORMATS,
    Format,
    orient_to_axis,
    read_splats,
    transform_file,
    undo_transforms,
    write_splats,
)
from dyngs.io.formats.similarity import IDENTITY, Similarity
from dyngs.io.formats.splat_file import SplatFile

LEAST_PSNR = {
    "ply": 99,
    "compressed-ply": 42,
    "spz": 36,
    "splat": 40,
    "sog": 35,
    "glb": 90,
    "usd": 90,
}
"""dB, of a scene whose harmonics are as strong as its base colours."""

without_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="needs usd-core")
every = pytest.mark.parametrize(
    "kind",
    [pytest.param(f, marks=without_usd if f.name == "usd" else (), id=f.name) for f in FORMATS],
)


def file_of(kind: Format, folder: Path) -> Path:
    return folder / f"a{kind.suffixes[0]}"


@every
def test_a_file_shows_what_was_written(kind: Format, tmp_path: Path) -> None:
    degree = min(3, kind.max_degree)
    scene = cloud(degree=degree)
    written = write_splats(file_of(kind, tmp_path), SplatFile(scene, eps2d=0.1))
    assert written.notes == ()
    back = read_splats(written.path)
    assert len(back.gaussians) == len(scene)
    assert back.gaussians.sh_degree == degree
    assert psnr(seen(back.gaussians), seen(scene)) > LEAST_PSNR[kind.name]


@every
def test_what_pointed_up_points_up_in_the_viewers_of_the_format(
    kind: Format, tmp_path: Path
) -> None:
    scene = cloud(degree=min(3, kind.max_degree))
    path = file_of(kind, tmp_path)
    back = read_splats(
        write_splats(path, orient_to_axis(SplatFile(scene, up="z"), None, path)).path
    )
    assert back.up == kind.up
    turn = orient_to_axis(SplatFile(scene, up="z"), None, path).turned
    assert psnr(seen(back.gaussians, cameras_turned(turn)), seen(scene)) > LEAST_PSNR[kind.name]
    assert orient_to_axis(SplatFile(scene, up="z"), "keep", path).gaussians is scene


@every
def test_what_the_format_cannot_say_is_said(kind: Format, tmp_path: Path) -> None:
    written = write_splats(
        file_of(kind, tmp_path), SplatFile(cloud(30, 4), RasterizeMode.ANTIALIASED)
    )
    said = " ".join(written.notes)
    assert (f"SH coefficients above degree {kind.max_degree} are dropped" in said) == (
        kind.max_degree < 4
    )
    assert ("antialiased" in said) == (not kind.stores_render_mode)
    if kind.stores_render_mode:
        assert splat_options(read_splats(written.path)).mode is RasterizeMode.ANTIALIASED


@every
def test_one_gaussian_exactly_opaque_and_one_exactly_transparent(
    kind: Format, tmp_path: Path
) -> None:
    scene = cloud(40, 0)
    logits = torch.linspace(-3, 3, 40)
    logits[0] = 40.0
    logits[1] = -200.0  # 1 and 0 in float32, or in 8 bits
    scene = scene.replace(logit_opacities=logits)
    back = read_splats(write_splats(file_of(kind, tmp_path), SplatFile(scene)).path)
    assert len(back.gaussians) == 40
    assert bool(back.gaussians.logit_opacities.isfinite().all())
    found = back.gaussians.opacities.sort().values
    assert float(found[0]) < 1e-6
    assert float(found[-1]) > 1 - 1e-6
    assert psnr(seen(back.gaussians), seen(scene)) > LEAST_PSNR[kind.name]


@every
def test_every_truncation_is_an_error(kind: Format, tmp_path: Path) -> None:
    path = file_of(kind, tmp_path)
    data = write_splats(path, SplatFile(cloud(40, min(1, kind.max_degree)))).path.read_bytes()
    for fraction in (0.5,) if kind.name == "usd" else (0.0, 0.01, 0.1, 0.5, 0.9, 0.999):
        # USD is slow to read
        # a .splat ends after any row
        path.write_bytes(data[: int(fraction * len(data)) - (kind.name == "splat")])
        with pytest.raises(DyngsError, match="a\\.") as refused:
            read_splats(path)
        assert "\n" not in str(refused.value)


def test_counts_beyond_the_file_cost_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import gzip
    import struct

    monkeypatch.delenv(LIMITS_VARIABLE, raising=False)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000_000, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(1000)))
    with pytest.raises(DyngsError, match="4,000,000,000 Gaussians exceed"):
        read_splats(tmp_path / "a.spz")
    bomb = struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0) + bytes(200 * 1000 * 1000)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bomb, 1))
    assert len(read_splats(tmp_path / "b.spz").gaussians) == 10


def test_the_original_place_is_known_from_a_ply(tmp_path: Path) -> None:
    for name in ("a.ply", "a.compressed.ply"):
        path = tmp_path / name
        splat = SplatFile(
            cloud(20, 1), RasterizeMode.ANTIALIASED, 0.1, (1.0, 2.0, 3.0), ("mine",), "z"
        )
        back = read_splats(write_splats(path, orient_to_axis(splat, None, path)).path)
        assert (back.mode, back.eps2d, back.world_offset, back.up) == (
            splat.mode,
            0.1,
            (1.0, 2.0, 3.0),
            "-y",
        )
        assert back.turned == pytest.approx(orient_to_axis(splat, None, path).turned)
        assert "mine" in back.comments
        again = read_splats(
            write_splats(
                path, replace(back, comments=(*back.comments, "caf\xe9", "two\rlines"))
            ).path
        )
        assert again.comments == back.comments  # nothing twice, nothing that breaks the header


@every
def test_the_place_of_a_far_scene_is_stored_or_told(kind: Format, tmp_path: Path) -> None:
    """In the axes of the capture in the file, in those of the file for people."""
    path = tmp_path / f"a{kind.suffixes[0]}"
    turn = Similarity((0.0, 1.0, 0.0, 0.0))
    splat = SplatFile(cloud(20, 0), world_offset=FAR, up=kind.up, turned=turn.turn)
    written = write_splats(path, splat)
    line = " ".join(f"{x:.12g}" for x in turn.points(np.array(FAR)))
    end = "stored in the file" if kind.stores_comments else f"{kind.name} cannot store it"
    assert written.notes == (
        f"the scene is far from the origin: {line} is subtracted from all positions ({end})",
    )
    back = read_splats(path)
    if kind.stores_comments:
        assert (back.world_offset, back.turned) == (FAR, turn.turn)


@pytest.mark.parametrize(
    "kind", [x for x in readable() if x.stores_comments], ids=lambda kind: kind.name
)
def test_edits_are_stored_and_undone(kind: Format, tmp_path: Path) -> None:
    path = tmp_path / f"a{kind.suffixes[0]}"
    before = SplatFile(cloud(30, kind.max_degree), up="-y", turned=(0.0, 0.0, 1.0, 0.0))
    edited = transform_file(
        transform_file(before, Similarity((0.6, 0.0, 0.8, 0.0), 0.5), "-y"),
        Similarity(shift=(1, 2, 3)),
        "-y",
    )
    back = read_splats(write_splats(path, orient_to_axis(edited, None, path)).path)
    assert back.edited.numbers == pytest.approx(orient_to_axis(edited, None, path).edited.numbers)
    undone = undo_transforms(back)
    assert (undone.up, undone.edited) == ("-y", IDENTITY)
    order = (before.gaussians.means[:, None] - undone.gaussians.means).norm(dim=2)
    assert float(order.amin(1).max()) < 0.02  # of a cloud of size 1, in the coarsest format


@every
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_files_hold_scenes_of_any_unit(kind: Format, factor: float, tmp_path: Path) -> None:
    scene = cloud(degree=min(1, kind.max_degree))
    written = write_splats(file_of(kind, tmp_path), SplatFile(scaled(scene, factor)))
    back = scaled(read_splats(written.path).gaussians, 1 / factor)
    least = LEAST_PSNR[kind.name] if kind.name != "spz" or factor < 1 else 30
    assert psnr(seen(back), seen(scene)) > min(least, 90)


KNOWN = Path(__file__).with_name("known")
"""Files of other programs; ``README.md`` there says how they were made."""
THREE = {
    "means": [[0.5, -1.25, 2.0], [-3.75, 0.125, 1.0], [1.0, 2.5, -0.75]],
    "quats": [[1.0, 0.0, 0.0, 0.0], [0.5, -0.5, 0.5, 0.5], [0.8, 0.0, -0.6, 0.0]],
    "log_scales": [[-3.0, -2.5, -4.0], [-5.0, -1.0, -2.0], [-2.25, -2.25, -6.5]],
    "logit_opacities": [1.5, -2.0, 0.25],
    "sh": [
        [[0.9, -0.3, 0.1], [0.25, 0.5, -0.5], [-0.125, 0.375, 0.125], [0.0, -0.25, 0.25]],
        [[-1.2, 0.6, 1.4], [-0.25, 0.0, 0.375], [0.25, -0.125, -0.375], [0.5, 0.125, 0.0]],
        [[0.0, 1.0, -1.0], [0.0, 0.25, -0.125], [0.0, 0.5, 0.0], [0.125, -0.5, 0.25]],
    ],
}
"""The Gaussians in ``three.ply``, -y up."""
OPACITY_BYTES = [208, 30, 143]  # 255 / (1 + exp(-logit)), rounded
COLOUR_BYTES = [[162, 116, 131], [82, 150, 181], [128, 166, 89]]  # of .spz: 38.25 sh + 127.5
TURNED = torch.tensor([1.0, -1.0, -1.0])
"""About x by half a turn, as between viewers with -y up and y up."""


def three() -> Gaussians:
    return Gaussians(**{name: torch.tensor(values) for name, values in THREE.items()})


def exactly(found: torch.Tensor, wanted: torch.Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(found, wanted, rtol=0, atol=tolerance)


def up_to_sign(found: torch.Tensor, wanted: torch.Tensor, tolerance: float) -> None:
    exactly((found * wanted).sum(1).abs(), torch.ones(len(found)), tolerance)


def test_a_ply_of_another_program() -> None:
    splat = read_splats(KNOWN / "three.ply")
    assert splat.up == "-y"
    for name, values in THREE.items():
        exactly(getattr(splat.gaussians, name), torch.tensor(values))


@pytest.mark.parametrize("name", ["three.spz", "three_v4.spz"])
def test_an_spz_of_another_program(name: str) -> None:
    """The bytes encode exactly these values; SH coefficients are multiples of 1/8."""
    if name == "three_v4.spz":
        pytest.importorskip("zstandard")
    found = read_splats(KNOWN / name).gaussians
    wanted = three()
    exactly(found.means, wanted.means * TURNED)
    exactly(found.log_scales, wanted.log_scales)
    opacity = torch.tensor(OPACITY_BYTES) / 255
    exactly(found.opacities, opacity)
    exactly(found.sh[:, 0], (torch.tensor(COLOUR_BYTES) / 255 - 0.5) / 0.15, 1e-5)
    # of degree 1: -y, z and -x of the direction from the camera
    exactly(found.sh[:, 1:], wanted.sh[:, 1:] * torch.tensor([-1.0, -1.0, 1.0])[:, None])
    w, x, y, z = wanted.quats.unbind(1)
    up_to_sign(found.quats, torch.stack([w, x, -y, -z], dim=1), 2e-5)


def test_an_spz_is_written_as_by_another_program(tmp_path: Path) -> None:
    """The same bytes for opacities, colours, scales and harmonics; centres have four more bits."""
    splat = SplatFile(three(), up="-y")
    written = write_splats(
        tmp_path / "ours.spz", orient_to_axis(splat, None, tmp_path / "ours.spz")
    ).path
    ours, theirs = (gzip.decompress(path.read_bytes()) for path in (written, KNOWN / "three.spz"))
    assert ours[:12] == theirs[:12]
    assert (ours[13], theirs[13]) == (16, 12)
    bits = [
        [
            int.from_bytes(data[i : i + 3], "little", signed=True) / 2 ** data[13]
            for i in range(16, 43, 3)
        ]
        for data in (ours, theirs)
    ]
    assert bits[0] == bits[1] == (three().means * TURNED).flatten().tolist()
    assert list(ours[43:46]) == OPACITY_BYTES
    assert ours[46:55] == bytes(value for colour in COLOUR_BYTES for value in colour)
    assert list(ours[55:64]) == [112, 120, 96, 80, 144, 128, 124, 124, 56]  # 16 (log scale + 10)
    assert ours[43:64] == theirs[43:64]
    assert ours[76:] == theirs[76:]


def test_a_splat_byte_by_byte(tmp_path: Path) -> None:
    """By the description of antimatter15's format; ``splat-transform`` reads this very file as the
    values below."""
    rows = (
        "0000003f0000a0bf00000040 86ed4b3d2e1ca83dae0a963c c06a87d0 ff808080",
        "000070c00000003e0000803f ffc9dc3bb25abc3e55950a3e 29abe41e c040c0c0",
        "0000803f00002040000040bf 8cdbd73d8cdbd73d0c0fc53a 80c7388f e6803380",
    )
    content = bytes.fromhex("".join(rows))
    written = write_splats(tmp_path / "ours.splat", SplatFile(three(), up="-y"), sh_degree=0).path
    assert written.read_bytes() == content
    found = read_splats(written).gaussians
    wanted = three()
    exactly(found.means, wanted.means)
    exactly(found.log_scales, wanted.log_scales)
    exactly(found.logit_opacities, torch.tensor([1.4873905, -2.0149031, 0.2443458]), 1e-5)
    colours = [
        [0.8966531, -0.2988844, 0.1042620],
        [-1.2024883, 0.6047195, 1.3971107],
        [0.0069508, 0.9939643, -0.9939643],
    ]
    exactly(found.sh[:, 0], torch.tensor(colours), 1e-5)
    up_to_sign(found.quats, wanted.quats, 1e-4)


def test_bytes_of_a_splat_are_the_nearest(tmp_path: Path) -> None:
    """Cut off instead of rounded, all colours would be darker, and rotations off to one side."""
    scene = cloud(200, 0)
    rows = np.frombuffer(
        write_splats(tmp_path / "a.splat", SplatFile(scene)).path.read_bytes(), np.uint8
    )
    written = torch.from_numpy(rows.reshape(-1, 32)[:, 24:].astype(np.float32))
    order = torch.argsort(
        scene.log_scales.double().sum(1).exp() * scene.opacities, descending=True, stable=True
    )
    colours = torch.cat([scene.base_rgb, scene.opacities[:, None]], dim=1).clamp(0, 1) * 255
    exact = torch.cat([colours, (scene.quats * 128 + 128).clamp(0, 255)], dim=1)[order]
    assert float((written - exact).abs().max()) <= 0.5 + 1e-4


def test_a_glb_of_another_program() -> None:
    """The scene is rotated by half a turn about z; colours come from the SH coefficients, not
    ``COLOR_0``."""
    found = read_splats(KNOWN / "three.glb").gaussians
    wanted = three()
    exactly(found.means, wanted.means * torch.tensor([-1.0, -1.0, 1.0]))
    exactly(found.log_scales, wanted.log_scales)
    exactly(found.logit_opacities, wanted.logit_opacities)
    exactly(found.sh, wanted.sh[:, :1])
    w, x, y, z = wanted.quats.unbind(1)
    up_to_sign(found.quats, torch.stack([-z, -y, x, w], dim=1), 1e-6)


def test_a_glb_is_written_as_by_another_program(tmp_path: Path) -> None:
    """The same attributes; but ``COLOR_0`` is linear, as glTF has it (that program writes sRGB
    there)."""
    path = write_splats(tmp_path / "ours.glb", SplatFile(three()), sh_degree=0).path
    ours = attributes(path)
    theirs = attributes(KNOWN / "three.glb")
    assert ours.keys() == theirs.keys()
    own = "KHR_gaussian_splatting"
    for name in (f"{own}:SCALE", f"{own}:OPACITY", f"{own}:SH_DEGREE_0_COEF_0"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=2e-7)  # one unit of float32
    np.testing.assert_allclose(
        ours[f"{own}:ROTATION"], np.array(THREE["quats"])[:, [1, 2, 3, 0]], atol=1e-7
    )
    srgb = theirs["COLOR_0"] / 255
    assert srgb[2, 2].round(3) == 0.220  # 0.5 - 0.2821: known in linear light as 0.039
    linear = [[0.52859, 0.14390, 0.24109], [0.02235, 0.40545, 0.77742], [0.21404, 0.57392, 0.03896]]
    np.testing.assert_allclose(ours["COLOR_0"][:, :3], linear, atol=1e-5)
    # theirs has 8 bits
    np.testing.assert_allclose(((srgb[:, :3] + 0.055) / 1.055) ** 2.4, linear, atol=3e-3)
    np.testing.assert_allclose(ours["COLOR_0"][:, 3], [0.81757, 0.11920, 0.56218], atol=1e-5)


@pytest.mark.parametrize(
    ("key", "other"), [("srgb_rec709_display", "lin_rec709_display"), ("ellipse", "splat")]
)
def test_a_glb_of_another_kind_is_refused(key: str, other: str, tmp_path: Path) -> None:
    """Linear colours would be drawn too dark."""
    path = write_splats(tmp_path / "a.glb", SplatFile(three()), sh_degree=0).path
    data = path.read_bytes()
    path.write_bytes(data.replace(f'"{key}"'.encode(), f'"{other}"'.ljust(len(key) + 2).encode()))
    with pytest.raises(DyngsError, match=rf"{other}.* is not supported, only {key}"):
        read_splats(path)


def test_a_sog_by_its_description(tmp_path: Path) -> None:
    """By PlayCanvas' description of version 2, in a reader of a few lines."""
    from PIL import Image

    path = write_splats(tmp_path / "a.sog", SplatFile(three(), up="-y")).path
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def pixels(part: str, index: int = 0) -> np.ndarray:
            with archive.open(meta[part]["files"][index]) as file, Image.open(file) as image:
                return np.asarray(image.convert("RGBA")).reshape(-1, 4)[: meta["count"]].astype(int)

        low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
        far = low + (pixels("means", 0) + 256 * pixels("means", 1))[:, :3] / 65535 * (high - low)
        means = np.sign(far) * (np.exp(np.abs(far)) - 1)
        order = np.abs(means[:, None] - np.array(THREE["means"])).sum(2).argmin(1)
        assert sorted(order) == [0, 1, 2]
        np.testing.assert_allclose(means, np.array(THREE["means"])[order], atol=1e-4)
        for rotation, row in zip(pixels("quats"), order, strict=True):
            parts = ((rotation[:3] / 255 - 0.5) * 2**0.5).tolist()
            parts.insert(rotation[3] - 252, max(0.0, 1 - sum(x * x for x in parts)) ** 0.5)
            assert abs(np.dot(parts, THREE["quats"][row])) > 0.9999
        np.testing.assert_allclose(
            np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]],
            np.array(THREE["log_scales"])[order],
            atol=0.05,
        )
        base = np.array(THREE["sh"])[order][:, 0]
        np.testing.assert_allclose(
            np.array(meta["sh0"]["codebook"])[pixels("sh0")[:, :3]], base, atol=0.02
        )
        assert pixels("sh0")[:, 3].tolist() == [OPACITY_BYTES[row] for row in order]


def test_a_compressed_ply_by_its_description(tmp_path: Path) -> None:
    """By SuperSplat's description, in a reader of a few lines; values in the middle of a range are
    rounded."""
    path = write_splats(tmp_path / "a.compressed.ply", SplatFile(three(), up="-y")).path
    header, _, data = path.read_bytes().partition(b"end_header\n")
    assert b"element chunk 1\n" in header
    low, high = (np.frombuffer(data, "<f4", 18)[:18].reshape(3, 2, 3)[:, end] for end in (0, 1))
    words = np.frombuffer(data, "<u4", 12, 72).reshape(3, 4).astype(np.int64)

    def fractions(column: int, *bits: int) -> np.ndarray:
        shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
        tops = 2 ** np.array(bits) - 1
        return ((words[:, column, None] >> shifts) & tops) / tops

    places = fractions(0, 11, 10, 11) * (high[0] - low[0]) + low[0]
    order = np.abs(places[:, None] - np.array(THREE["means"])).sum(2).argmin(1)
    assert sorted(order) == [0, 1, 2]
    span = np.abs(places - np.array(THREE["means"])[order]) / (high[0] - low[0])
    assert (span <= 0.5001 / np.array([2047, 1023, 2047])).all()
    scales = fractions(2, 11, 10, 11) * (high[1] - low[1]) + low[1]
    np.testing.assert_allclose(scales, np.array(THREE["log_scales"])[order], atol=0.51 * 4.5 / 1023)
    colours = fractions(3, 8, 8, 8, 8)
    rgb = np.array(THREE["sh"])[order][:, 0] * 0.28209479 + 0.5
    np.testing.assert_allclose(colours[:, :3] * (high[2] - low[2]) + low[2], rgb, atol=0.51 / 255)
    assert (255 * colours[:, 3]).round().tolist() == [OPACITY_BYTES[row] for row in order]
    rest = np.frombuffer(data, np.uint8, 27, 72 + 48).reshape(3, 3, 3)  # of degree 1, by channel
    wanted = np.array(THREE["sh"])[order][:, 1:].transpose(0, 2, 1)
    np.testing.assert_allclose((rest + 0.5) / 256 * 8 - 4, wanted, atol=0.0157)


def attributes(path: Path) -> dict[str, np.ndarray]:
    """The numbers of the first primitive of a .glb, by a reader of a few lines."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    found = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        start = 28 + size + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        count = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5121: "u1", 5126: "<f4"}[accessor["componentType"]]
        found[name] = np.frombuffer(data, kind, accessor["count"] * count, start).reshape(-1, count)
    return found
