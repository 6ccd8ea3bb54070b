"""Textured scans as captures: silhouettes, colours and depth are those of the scanned body, from
files as THuman2.0, RenderPeople and others write them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from refused import error_line
from scipy.ndimage import distance_transform_edt
from tiny_stereo import stereo_config
from trimesh.visual.material import SimpleMaterial
from trimesh.visual.texture import TextureVisuals

from dyngs.cli import main
from dyngs.config import DataConfig
from dyngs.data.loader import ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.mesh import rasterize
from dyngs.human.predict.gps.stereo import learner
from dyngs.human.synthetic.capture import (
    DirectionalLight,
    Outfit,
    PeopleOptions,
    PosedMesh,
    dress_body,
    outfit_paint,
    random_outfit,
    render_mesh,
)
from dyngs.human.synthetic.scans import read_scan, texture_paint, write_scans

OPTIONS = PeopleOptions(size=64, cameras=2)


@dataclass(frozen=True)
class TexturedPerson:
    """A dressed body in centimetres, beside the origin and above the floor, with a texture."""

    vertices: np.ndarray  # (M, 3)
    faces: np.ndarray  # (T, 3)
    uv: np.ndarray  # (U, 2)
    uv_faces: np.ndarray  # (T, 3)
    texture: np.ndarray  # (S, S, 3)


def body_texture(body: BodyTemplate, outfit: Outfit, side: int) -> np.ndarray:
    """The paint of an outfit as a texture (S, S, 3); bare texels repeat the nearest one."""
    assert body.uv is not None
    assert body.uv_faces is not None
    flat = np.pad(body.uv.double().numpy(), ((0, 0), (0, 1)), constant_values=1.0)
    flat = flat * [side, -side, 1] + [-0.5, side - 0.5, 0]
    fragments = rasterize(flat[body.uv_faces.numpy()], side, side)
    texture = np.zeros((side * side, 3))
    texture[fragments.index] = outfit_paint(body, outfit)(fragments)
    is_bare = np.ones(side * side, dtype=bool)
    is_bare[fragments.index] = False
    nearest = distance_transform_edt(
        is_bare.reshape(side, -1), return_distances=False, return_indices=True
    )
    row, column = np.asarray(nearest)
    return texture.reshape(side, side, 3)[row, column]


@pytest.fixture(scope="module")
def person() -> TexturedPerson:
    outfit = random_outfit(3)
    bare = default_template()
    body = dress_body(bare, outfit)
    assert body.uv is not None
    assert body.uv_faces is not None
    return TexturedPerson(
        vertices=90.0 * body.vertices.double().numpy() + [30.0, 120.0, -20.0],
        faces=body.faces.numpy(),
        uv=body.uv.double().numpy(),
        uv_faces=body.uv_faces.numpy(),
        texture=np.round(255 * body_texture(bare, outfit, 128)) / 255,
    )


@pytest.fixture(scope="module")
def files(person: TexturedPerson, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The person as .obj with material and image, and as .glb."""
    out = tmp_path_factory.mktemp("files")
    owner = np.zeros(len(person.uv), dtype=np.int64)
    owner[person.uv_faces.ravel()] = person.faces.ravel()
    image = Image.fromarray(np.round(255 * person.texture).astype(np.uint8))
    visual = TextureVisuals(person.uv, SimpleMaterial(image=image))
    mesh = trimesh.Trimesh(person.vertices[owner], person.uv_faces, visual=visual, process=False)
    mesh.export(out / "0042.obj")
    mesh.export(out / "0042.glb")
    image.save(out / "photo.jpeg", quality=100, subsampling=0)
    return out


def thuman(files: Path, out: Path) -> Path:
    """``0042/0042.obj`` with its material, whose image is ``material0.jpeg``."""
    folder = out / "0042"
    folder.mkdir(parents=True)
    text = (files / "0042.obj").read_text().replace("material.mtl", "material0.mtl")
    (folder / "0042.obj").write_text(text)
    material = (files / "material.mtl").read_text()
    (folder / "material0.mtl").write_text(material.replace("material_0.png", "material0.jpeg"))
    shutil.copy(files / "photo.jpeg", folder / "material0.jpeg")
    return out


def renderpeople(files: Path, out: Path) -> Path:
    """An .obj whose material names an image that is missing, and several images in ``tex``."""
    folder = out / "rp_ann_OBJ"
    (folder / "tex").mkdir(parents=True)
    shutil.copy(files / "0042.obj", folder / "rp_ann_100k.obj")
    (folder / "material.mtl").write_text("newmtl material_0\nmap_Kd C:\\work\\rp_ann_dif.jpg\n")
    shutil.copy(files / "photo.jpeg", folder / "tex" / "rp_ann_dif_2k.jpeg")
    Image.new("RGB", (8, 8)).save(folder / "tex" / "rp_ann_norm_2k.jpeg")
    return out


def plain(files: Path, out: Path) -> Path:
    """Both formats of one scan, and a hidden file, as some systems leave behind."""
    shutil.copytree(files, out)
    (out / "photo.jpeg").unlink()
    (out / "._0042.obj").write_bytes(b"\0")
    return out


@pytest.mark.parametrize("layout", [thuman, renderpeople, plain])
def test_images_and_depth_are_those_of_the_body(
    layout: Callable[[Path, Path], Path], person: TexturedPerson, files: Path, tmp_path: Path
) -> None:
    """Rendered from the original with its own UV map, scaled to 1.8 m, on the floor."""
    write_scans(layout(files, tmp_path / "scans"), tmp_path / "out", OPTIONS)
    (data,) = list_captures(DataConfig(root=tmp_path / "out", test_every=0))
    views = read_capture(data).splits["train"]
    assert len(views) == 2
    low = person.vertices.min(0)
    high = person.vertices.max(0)
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    vertices = 1.8 * (person.vertices - foot) / (high[1] - low[1])
    paint = texture_paint(person.uv, person.uv_faces, person.texture)
    truth = PosedMesh(vertices, person.faces, paint)
    light = DirectionalLight(ambient=(1.0,), diffuse=(0.0,))
    for image in ImageLoader(views, data, with_maps=True):
        assert image.alpha is not None
        assert image.depth is not None
        pose = np.linalg.inv(image.cameras.cam_from_world[0].double().numpy())
        pose = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
        pixels = render_mesh(truth, pose, 64, 2, light)
        alpha = image.alpha.numpy()
        assert 0.05 < alpha.mean() < 0.5
        np.testing.assert_allclose(alpha, pixels[..., 3], atol=0.26 / 64)
        solid = alpha == 1
        rgb = image.rgb_premultiplied.numpy()[solid]
        exact = layout is plain
        error = np.abs(rgb - pixels[..., :3][solid])
        assert error.mean() < (0.003 if exact else 0.02)
        known = image.depth.numpy() > 0
        rows, columns = known.nonzero()
        focal = float(image.cameras.intrinsics[0, 0, 0])
        rays = np.stack([columns + 0.5 - 32, 32 - rows - 0.5, np.full(len(rows), -focal)], axis=1)
        points = image.depth.numpy()[known][:, None] / focal * rays @ pose[:3, :3].T + pose[:3, 3]
        assert points[:, 1].min() > -0.01
        assert points[:, 1].max() == pytest.approx(1.8, abs=0.06)


def test_scans_train_networks_and_are_kept(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Again with one scan more: the first one is kept. Other options are refused."""
    folder = plain(files, tmp_path / "scans")
    out = tmp_path / "out"
    words = ["data", "scans", str(folder), str(out), "--size", "24", "--cameras", "16"]
    assert main(words) == 0
    assert f"dyngs train gps {out}" in capsys.readouterr().out
    network = learner(stereo_config(out, tmp_path / "run"), torch.Generator().manual_seed(0))
    assert network.names == ["0042"]
    example = network.example(0, 1, torch.Generator().manual_seed(0))
    assert 0 < example.scores["end_point_error_px"] < 50
    stored = {path: path.read_bytes() for path in out.rglob("*.png")}
    assert len(stored) == 32
    shutil.copy(files / "0042.glb", folder / "0043.glb")
    assert main(words) == 0
    assert {path.name for path in (out / "scans").iterdir()} == {"0042", "0043"}
    assert {path: path.read_bytes() for path in stored} == stored
    assert "other options" in error_line(capsys, *words, "--seed", "1")


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("a.txt", b"", "contains no .obj or .glb files"),
        ("a.obj", b"nonsense\n", "a.obj: cannot be read"),
        ("a.glb", b"glTF\x02\0\0\0\xff\xff\xff\xff", "a.glb: cannot be read"),
        ("a.obj", SQUARE.encode(), "a.obj: has no texture; put one image beside it"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "a.obj: cannot be read"),
    ],
)
def test_bad_scans_are_refused_in_one_line(
    name: str, content: bytes, part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    (folder / name).write_bytes(content)
    assert part in error_line(capsys, "data", "scans", str(folder), str(tmp_path / "out"))


def test_flat_people_and_wrong_numbers_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "flat.obj").write_text(
        SQUARE.replace("v 0 1 0", "v 0 0.1 0").replace("1 1 0", "1 0.1 0")
    )
    Image.new("RGB", (8, 8)).save(tmp_path / "flat.png")
    words = ["data", "scans", str(tmp_path), str(tmp_path / "out")]
    assert "no person who stands along y" in error_line(capsys, *words)
    assert "size, cameras" in error_line(capsys, *words[:3], str(tmp_path / "b"), "--size", "0")


def test_textures_repeat_beyond_the_unit_square(tmp_path: Path) -> None:
    """A wall whose coordinates go from 2 to 3 looks like one from 0 to 1."""
    colours = np.random.default_rng(0).integers(0, 255, (4, 8, 3), dtype=np.uint8)
    Image.fromarray(colours).save(tmp_path / "wall.png")
    pixels = []
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.9, 3.0]
    for shift in (0, 2):
        text = SQUARE
        for corner in ("0 0", "1 0", "1 1", "0 1"):
            u, v = (int(x) + shift for x in corner.split())
            text = text.replace(f"vt {corner}\n", f"vt {u} {v}\n", 1)
        (tmp_path / "wall.obj").write_text(text)
        mesh = read_scan(tmp_path / "wall.obj")
        pixels.append(
            render_mesh(mesh, pose, 32, 1, DirectionalLight(ambient=(1.0,), diffuse=(0.0,)))
        )
    np.testing.assert_allclose(pixels[0], pixels[1], atol=1e-9)
    assert pixels[0][..., 3].mean() > 0.1
