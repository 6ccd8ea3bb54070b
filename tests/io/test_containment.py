"""The border of a capture: links, absolute paths and ``..`` that leave it, in every reader; and
sizes of images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import (
    edit_json,
    random_pixels,
    write_cameras_json,
    write_colmap,
    write_folder,
    write_frames,
    write_image,
    write_nerfies,
    write_poses_bounds,
    write_video,
)

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.io.containment import check_inside, check_size, find_escaping_links, restrict_paths_to

PLY = (
    "ply\nformat ascii 1.0\nelement vertex 1\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n0 0 1\n"
)


def read(root: Path, **options: object) -> Capture:
    return read_capture(DataConfig(root=root, test_every=0, **options))  # type: ignore[arg-type]


def write_nerfstudio(root: Path) -> None:
    names = [f"images/{i}.png" for i in range(3)]
    for i, name in enumerate(names):
        write_image(root / name, random_pixels(8, 12, 3, seed=i))
        write_image(root / "masks" / f"{i}.png", random_pixels(8, 12, 1, seed=i))
    write_frames(
        root / "transforms.json",
        names,
        {"w": 12, "h": 8, "fl_x": 10.0, "ply_file_path": "points.ply"},
    )
    (root / "points.ply").write_text(PLY)
    edit_json(
        root / "transforms.json",
        lambda content: content["frames"][0].update(mask_path="masks/0.png"),
    )


def write_video_cameras(root: Path) -> None:
    write_cameras_json(root, ["a", "b"])
    write_video(root / "a.mp4", 2)
    write_folder(root / "b", [0, 1])


def write_llff(root: Path) -> None:
    write_poses_bounds(root, 2)
    for name in ("cam00", "cam01"):
        write_folder(root / name, [0, 1])


def write_points(root: Path) -> None:
    write_nerfies(root)
    np.save(root / "points.npy", np.ones((4, 3)))


WRITERS: dict[str, Callable[[Path], object]] = {
    "nerfstudio": write_nerfstudio,
    "videos": write_video_cameras,
    "llff": write_llff,
    "nerfies": write_points,
    "colmap": write_colmap,
}
FILES = [
    *(
        ("nerfstudio", name)
        for name in ("images", "images/1.png", "masks/0.png", "points.ply", "transforms.json")
    ),
    *(("videos", name) for name in ("a.mp4", "b", "b/frame_0001.png", "cameras.json")),
    *(("llff", name) for name in ("poses_bounds.npy", "cam00/frame_0000.png", "cam01")),
    *(
        ("nerfies", name)
        for name in ("points.npy", "scene.json", "metadata.json", "rgb/1x/000001.png", "rgb")
    ),
    *(("nerfies", f"camera/{i:06d}.json") for i in range(2)),
    *(
        ("colmap", name)
        for name in (
            "images/left",
            "images/left/01.jpg",
            "sparse/0/points3D.bin",
            "sparse",
            "images",
        )
    ),
]


@pytest.mark.parametrize(("kind", "name"), FILES)
def test_no_reader_opens_what_lies_outside(kind: str, name: str, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    WRITERS[kind](root)
    wanted = read(root)
    (tmp_path / "private").mkdir()
    shutil.move(root / name, tmp_path / "private" / "own")
    (root / name).symlink_to("../" * (name.count("/") + 1) + "private/own")
    with pytest.raises(
        DyngsError, match=r"private/own.*outside the capture.*data\.follow_links=true"
    ):
        read(root)
    followed = read(root, follow_links=True)
    assert [view.name for view in followed.splits["train"]] == [
        view.name for view in wanted.splits["train"]
    ]


@pytest.mark.parametrize(
    "written", ["../own.png", "{tmp}/own.png", "images/../../own.png", "..\\own.png", "../own"]
)
@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_paths_that_leave_the_capture(key: str, written: str, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    write_nerfstudio(root)
    write_image(tmp_path / "own.png", random_pixels(8, 12, 3))
    name = written.format(tmp=tmp_path)
    edit_json(root / "transforms.json", lambda content: content["frames"][1].update({key: name}))
    with pytest.raises(DyngsError, match=r"own(\.png)?, outside the capture"):
        read(root)
    assert len(read(root, follow_links=True).splits["train"]) == 3


def test_a_capture_that_is_a_link_and_links_inside_it_are_fine(tmp_path: Path) -> None:
    root = tmp_path / "real"
    write_nerfstudio(root)
    shutil.move(root / "images" / "1.png", root / "one.png")
    (root / "images" / "1.png").symlink_to("../one.png")
    (root / "images" / "2.png").rename(root / "two.png")
    (root / "images" / "2.png").symlink_to(root / "two.png")
    (tmp_path / "link").symlink_to("real")
    assert len(read(tmp_path / "link").splits["train"]) == 3
    os.chdir(root)
    assert len(read(Path(".")).splits["train"]) == 3
    assert find_escaping_links(tmp_path / "link") == []


def test_links_that_leave_are_listed_and_none_is_followed(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    (root / "a").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (root / "a" / "up").symlink_to("../..")
    (root / "in").symlink_to("a")
    (root / "gone").symlink_to("/nowhere/at/all")
    (root / "loop").symlink_to("loop")
    found = [
        (path.relative_to(root).as_posix(), place) for path, place in find_escaping_links(root)
    ]
    assert found == [("gone", "/nowhere/at/all"), ("a/up", os.path.realpath(tmp_path))]


def test_a_folder_whose_name_begins_the_same_is_outside(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    with restrict_paths_to(tmp_path / "capture"):
        assert check_inside(tmp_path / "capture" / "a.png") == tmp_path / "capture" / "a.png"
        with pytest.raises(DyngsError, match="outside the capture"):
            check_inside(tmp_path / "capture2" / "a.png")
    assert check_inside(tmp_path / "capture2" / "a.png"), "without a border"


def test_sizes() -> None:
    check_size(Path("a.png"), 10_000, 10_000)
    with pytest.raises(
        DyngsError, match=r"a\.png: 400,000,000 pixels exceed the limit of 150,000,000.*LIMITS=3"
    ):
        check_size(Path("a.png"), 20_000, 20_000)
    with pytest.raises(DyngsError, match=r"250,000,000 pixels exceed"):
        check_size(Path("a.exr"), 1000, 1000, 1000)
