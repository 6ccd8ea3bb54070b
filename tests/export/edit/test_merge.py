"""Several still scenes in one: each Gaussian as it was, upright with the first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from moving_scene import write_moving_run
from scaled_files import FAR
from splat_scenes import cameras_turned, cloud, seen

from dyngs.export.edit.merge import merge_scenes
from dyngs.io.formats.formats import orient_to_axis, write_splats
from dyngs.io.formats.similarity import Similarity
from dyngs.io.formats.splat_file import SplatFile


def test_files_and_runs_are_added(tmp_path: Path) -> None:
    """The degree is that of the richest one; a scene turned for a format is turned back."""
    first = SplatFile(cloud(40, 1), up="-y")
    other = SplatFile(cloud(30, 3, seed=1), up="-y")
    path = write_splats(tmp_path / "a.ply", orient_to_axis(other, "y", tmp_path / "a.ply")).path
    run = write_moving_run(tmp_path, moves=False)
    told: list[str] = []
    both = merge_scenes(first, (0.0, -1.0, 0.0), (path, run), told.append)
    assert (len(both.gaussians), both.gaussians.sh_degree, both.up) == (75, 3, "-y")
    assert told == [f"{path}: 30 Gaussians added", f"{run}: 5 Gaussians added"]
    torch.testing.assert_close(seen(both.gaussians.select(torch.arange(40))), seen(first.gaussians))
    torch.testing.assert_close(
        seen(both.gaussians.select(torch.arange(40, 70))), seen(other.gaussians), rtol=0, atol=5e-5
    )
    as_they_are = merge_scenes(first, None, (path,), told.append).gaussians.select(
        torch.arange(40, 70)
    )
    turned = cameras_turned((0.0, 1.0, 0.0, 0.0))
    torch.testing.assert_close(seen(as_they_are, turned), seen(other.gaussians), rtol=0, atol=5e-5)


def test_scenes_far_from_the_origin_lie_as_in_the_world(tmp_path: Path) -> None:
    """Two files of one survey, less an offset of each, turned for viewers in different ways."""
    first = cloud(20, 0)
    other = cloud(30, 0, seed=1)
    splat = SplatFile(
        Similarity((0.0, 1.0, 0.0, 0.0)).gaussians(first),
        world_offset=FAR,
        turned=(0.0, 1.0, 0.0, 0.0),
    )
    x, y, z = FAR
    path = write_splats(
        tmp_path / "b.ply", SplatFile(other, world_offset=(x + 3, y - 2, z + 1), up="z")
    ).path
    both = merge_scenes(splat, (0.0, -1.0, 0.0), (path,), lambda _: None)
    world = splat.frame.inverse().points(both.gaussians.means.numpy())
    np.testing.assert_allclose(world[:20], first.means.numpy(), atol=1e-6)
    np.testing.assert_allclose(world[20:], other.means.numpy() + np.array([3, -2, 1]), atol=1e-6)
