"""Sets of synthetic people: the same bytes, and depth that fits the images."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.loader import ImageLoader
from dyngs.data.read import list_captures
from dyngs.human.synthetic.capture import PeopleOptions, write_people

SMALL = PeopleOptions(people=2, size=64, cameras=3)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_people(tmp_path_factory.mktemp("people") / "set", SMALL)


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
