"""The synthetic person."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from scipy.spatial import ConvexHull

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.data.body_frames import match_frames, merge_root_rotation
from dyngs.data.capture import Capture, View
from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.capture import (
    HumanOptions,
    write_human_capture,
)

TINY = HumanOptions(size=24, num_frames=2, num_pose_frames=2, num_cameras=3, num_test=1, samples=1)


@cache
def body() -> BodyTemplate:
    return default_template()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_human_capture(tmp_path_factory.mktemp("person") / "out", TINY)


def posed(motion: Motion, frame: int) -> np.ndarray:
    exact = body().to(dtype=torch.float64)
    return posed_vertices(exact, motion.poses[[frame]].double(), motion.trans[[frame]].double())[
        0
    ].numpy()


def pixels(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))


def files(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def captured(folder: Path) -> Capture:
    return read_capture(DataConfig(root=folder))  # type: ignore[call-arg]


def seen_at(view: View, points: np.ndarray) -> np.ndarray:
    """(P, 2) column and row."""
    u, v, w = view.intrinsics @ (
        view.cam_from_world[:3, :3] @ points.T + view.cam_from_world[:3, 3:]
    )
    return np.stack([u / w, v / w], axis=-1)


def test_one_seed_gives_the_same_bytes(root: Path, tmp_path: Path) -> None:
    assert files(write_human_capture(tmp_path / "again", TINY)) == files(root)


def test_the_parameters_pose_the_template_as_the_images_show_it(root: Path) -> None:
    """Through the readers: the pelvis lies inside the silhouette, and the silhouette just fills the
    posed vertices'."""
    capture = captured(root)
    assert capture.body is not None
    exact = body().to(dtype=torch.float64)
    for split, views in capture.splits.items():
        if not views:
            continue
        own = merge_root_rotation(capture.body[split], exact.joints[0].numpy())
        rows = match_frames(root, own, views)
        poses, trans, scale = (torch.from_numpy(x[rows]) for x in (own.poses, own.trans, own.scale))
        assert (scale == 1).all()
        for view, vertices, shift in zip(
            views, posed_vertices(exact, poses, trans).numpy(), trans.numpy(), strict=True
        ):
            is_person = pixels(view.image_path)[..., 3] == 255
            column, row = seen_at(view, (exact.joints[0].numpy() + shift)[None])[0].astype(int)
            assert is_person[row, column]
            positions = seen_at(view, vertices)
            rows_seen, columns_seen = np.nonzero(is_person)
            for found, expected in ((columns_seen, positions[:, 0]), (rows_seen, positions[:, 1])):
                assert expected.min() - 0.5 <= found.min() + 0.5 <= expected.min() + 2
                assert expected.max() - 2 <= found.max() + 0.5 <= expected.max() + 0.5
            visual_hull = ConvexHull(positions).equations
            centers = np.stack([columns_seen, rows_seen], axis=-1) + 0.5
            assert (centers @ visual_hull[:, :2].T + visual_hull[:, 2] <= 1e-9).all()
