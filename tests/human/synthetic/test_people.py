"""Sets of synthetic people: the same bytes, and depth that fits the images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.loader import ImageLoader
from dyngs.data.read import list_captures
from dyngs.human.body.body import posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.mesh import Fragments
from dyngs.human.synthetic.capture import (
    DirectionalLight,
    PeopleOptions,
    PosedMesh,
    dress_body,
    person_options,
    random_outfit,
    render_mesh,
    write_human_capture,
    write_people,
)

HEIGHTS = {"chest": 0.4, "knee": -0.28, "shin": -0.55}  # in T-pose, m
SMALL = PeopleOptions(people=2, size=64, cameras=3)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_people(tmp_path_factory.mktemp("people") / "set", SMALL)


def grey(fragments: Fragments) -> np.ndarray:
    return np.full((len(fragments.index), 3), 0.5)


def contents(root: Path) -> dict[str, bytes]:
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_the_same_options_give_the_same_bytes_also_in_parts(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    write_people(out, PeopleOptions(people=1, size=64, cameras=3))
    assert len(list_captures(DataConfig(root=out))) == 1
    write_people(out, SMALL)
    assert contents(out) == contents(root)


def test_depth_and_silhouettes_agree_between_views(root: Path) -> None:
    """A pixel's point, by its depth, lies inside the silhouettes of all other views."""
    for data in list_captures(DataConfig(root=root, test_every=0)):
        views = read_capture(data).splits["train"]
        images = [*ImageLoader(views, data, with_maps=True)]
        assert len(images) == 3
        for image in images:
            assert image.depth is not None
            assert image.alpha is not None
            assert (image.depth[image.alpha == 1] > 0).float().mean() > 0.99, (
                "depth is of centres of pixels"
            )
            assert (image.alpha[image.depth > 0] > 0).float().mean() > 0.99
            rows, columns = (image.depth > 0).nonzero(as_tuple=True)
            pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=1)
            seen = image.depth[rows, columns][:, None] * (
                pixels @ torch.linalg.inv(image.cameras.intrinsics[0]).T
            )
            pose = image.cameras.cam_from_world[0]
            points = (seen - pose[:3, 3]) @ pose[:3, :3]
            assert float(points[:, 1].min()) + 0.02 >= 0
            for other in images:
                assert other.alpha is not None
                there = (
                    points @ other.cameras.cam_from_world[0, :3, :3].T
                    + other.cameras.cam_from_world[0, :3, 3]
                )
                flat = there @ other.cameras.intrinsics[0].T
                column, row = (flat[:, :2] / flat[:, 2:]).long().T
                wide = torch.nn.functional.max_pool2d(other.alpha[None], 3, 1, 1)[0]
                assert (wide[row, column] > 0).float().mean() > 0.99


def test_mismatched_options_are_refused(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="people with other options"):
        write_people(root, PeopleOptions(people=2, size=32, cameras=3))
    (tmp_path / "file").touch()
    with pytest.raises(DyngsError, match="exists already"):
        write_people(tmp_path, SMALL)
    for bad in (
        PeopleOptions(people=0),
        PeopleOptions(size=0),
        PeopleOptions(cameras=0),
        PeopleOptions(seed=-1),
    ):
        with pytest.raises(DyngsError, match=">= 1"):
            write_people(tmp_path / "new", bad)
    assert not (tmp_path / "new").exists()


def test_a_skirt_closes_the_gap_between_the_legs_in_every_pose() -> None:
    body = default_template()
    trousers = replace(random_outfit(1), hem=0.18)
    skirt = replace(trousers, hem=-0.35, flare=0.3)
    poses = torch.zeros(1, len(JOINT_NAMES), 3)
    poses[0, JOINT_NAMES.index("left_hip"), 2] = 0.3  # legs apart
    poses[0, JOINT_NAMES.index("right_hip"), 2] = -0.3
    camera = np.eye(4)
    camera[2, 3] = 3.5
    shown = []
    for outfit in (trousers, skirt):
        clothed = dress_body(body, outfit)
        torch.testing.assert_close(clothed.weights.sum(1), torch.ones(len(clothed.weights)))
        vertices = posed_vertices(clothed, poses, torch.zeros(1, 3))[0].double().numpy()
        mesh = PosedMesh(vertices, body.faces.numpy(), grey)
        shown.append(render_mesh(mesh, camera, 128, 1)[..., 3] > 0)
    rows = {name: 64 + round(-y * 0.5 * 128 / np.tan(0.3456) / 3.5) for name, y in HEIGHTS.items()}
    assert not shown[0][rows["knee"], 64]
    assert shown[1][rows["chest"] : rows["knee"], 64].all()
    wide = np.flatnonzero(shown[1][rows["knee"]])
    assert (np.diff(wide) == 1).all(), "one closed shape"
    assert shown[1][rows["knee"]].sum() > 1.3 * shown[0][rows["knee"]].sum()
    below = rows["shin"]
    np.testing.assert_array_equal(shown[1][below], shown[0][below])


def test_clothes_hair_and_light_differ_between_people() -> None:
    outfits = [random_outfit(seed, is_everyday=True) for seed in range(1, 41)]
    skirts = [outfit for outfit in outfits if outfit.hem < -0.2]
    assert 4 <= len(skirts) <= 16
    assert 10 <= sum(outfit.long_hair > 0.05 for outfit in outfits) <= 25
    body = default_template()
    long_haired = replace(outfits[0], long_hair=0.3)
    heads = [dress_body(body, replace(long_haired, long_hair=x)).vertices for x in (0.0, 0.3)]
    lowered = (heads[0] - heads[1])[:, 1]
    assert float(lowered.min()) >= 0
    assert 0.2 < float(lowered.max()) <= 0.3
    assert 20 < int((lowered > 0.05).sum()) < 1000


def test_the_sky_adds_a_quadratic_polynomial_of_the_normal() -> None:
    """Flat triangle that faces the camera: n = (0, 0, 1), so that n_z and n_z^2 are 1."""
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]])
    faces = np.array([[0, 1, 2]])
    mesh = PosedMesh(corners, faces, grey)
    sky = np.zeros((9, 3))
    sky[2] = 0.1, 0.2, 0.3
    sky[5] = 0.4
    sky[[0, 1, 3, 4, 6, 7, 8]] = 9.0
    camera = np.eye(4)
    camera[2, 3] = 3.5
    light = DirectionalLight(ambient=(0.2,), diffuse=(0.0,), sky=sky.tolist())
    rgb = render_mesh(mesh, camera, 8, 1, light)[4, 4, :3]
    np.testing.assert_allclose(rgb, 0.5 * (0.2 + 0.4 + np.array([0.1, 0.2, 0.3])), atol=1e-9)


def test_bodies_have_errors_but_the_images_are_those_of_the_exact_body(tmp_path: Path) -> None:
    options = person_options(PeopleOptions(size=32, cameras=1), 1)
    roots = [
        write_human_capture(tmp_path / str(error), replace(options, body_error=error))
        for error in (0.0, 0.5)
    ]
    exact, estimated = (np.load(root / "body_train.npz") for root in roots)
    error = estimated["betas"] - exact["betas"]
    assert 0.3 < error.std() < 0.7
    np.testing.assert_array_equal(exact["poses"], estimated["poses"])
    np.testing.assert_array_equal(exact["trans"], estimated["trans"])
    images = [contents(root / "images") for root in roots]
    assert images[0] == images[1]
