"""Edited runs: one similarity in all that leaves them, and nothing lost on the way back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import write_moving_run

from dyngs.api.edit import Edits, edit_scene
from dyngs.core.errors import DyngsError
from dyngs.export.cameras import write_cameras
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.edit.frame import Frame
from dyngs.export.splat_files import (
    DEFAULT_WRITE_OPTIONS,
    choose_write_options,
    splats_at,
    tracks_of,
    write_run_splats,
)
from dyngs.gaussians.rendering import render, splat_options
from dyngs.io.formats.formats import read_splats
from dyngs.io.formats.similarity import Similarity
from dyngs.models.views import training_cameras
from dyngs.runs.opened import open_run
from dyngs.view.session import Keyframe, Recording

EDITS = Edits(frame=Frame(up=(0.0, 0.6, 0.8), origin=(0.5, 0.25, 0.0), scale=3.0))


def silent(text: str) -> None:
    """Discard a progress message."""


def edited(run: Path, edits: Edits = EDITS, name: str = "edited") -> Path:
    return edit_scene(run, run.parent / name, edits, tell=silent).path


def expected(run: Path) -> Similarity:
    return EDITS.frame.similarity((0.0, 0.6, 0.8), (0.0, 0.0, 1.0))


def test_files_of_gaussians_cameras_and_tracks_move_as_one(tmp_path: Path) -> None:
    """Exported cameras, Gaussians and tracks of an edited run agree with the edited scene."""
    run = write_moving_run(tmp_path)
    opened = open_run(edited(run))
    how = expected(run)
    times = (0.0, 0.75)
    wanted = [how.points(opened.scene.at(t).means.numpy()) for t in times]
    tracks = tracks_of(opened.scene, times, opened.world)
    for i, found in enumerate(wanted):
        np.testing.assert_allclose(tracks.positions[:, i], found, atol=1e-5)
    file = write_run_splats(opened, tmp_path / "a.ply", 0.75).path
    read = read_splats(file)
    np.testing.assert_allclose(read.gaussians.means.numpy(), wanted[1], atol=1e-5)
    path = write_cameras(
        tmp_path / "cameras" / "transforms.json",
        opened.capture,
        opened.capture.splits,
        opened.world,
    )
    frames = json.loads(path.read_text())["frames"]
    cameras = training_cameras(opened.capture.splits["train"][:1], opened.config.data)[0]
    pose = np.array(frames[0]["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])
    there = replace(cameras, cam_from_world=torch.from_numpy(np.linalg.inv(pose)).float()[None])
    options = replace(splat_options(read), near=0.6)
    seen = render(read.gaussians, there, options, background=torch.ones(3)).rgb
    torch.testing.assert_close(seen, opened.scene.render(cameras, 0.75).rgb, rtol=0, atol=2e-4)
    assert (seen < 0.9).any()


def test_files_have_the_up_of_their_format_and_can_be_undone(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    opened = open_run(edited(run))
    assert opened.up is not None
    np.testing.assert_allclose(opened.up[0], [0.0, 0.6, 0.8], atol=1e-7)
    how, line = choose_write_options(opened, "-y")
    assert line == "up is -y in the file (rotated from z in the edited run; source: the edit)"
    splat = splats_at(opened, opened.scene, 0.0, how)
    np.testing.assert_allclose(splat.frame.rotation @ [0.0, 0.6, 0.8], [0, -1, 0], atol=1e-7)
    back = splat.edited.inverse().gaussians(splat.gaussians)
    torch.testing.assert_close(back.means, opened.scene.at(0.0).means, rtol=0, atol=1e-5)
    assert choose_write_options(opened, "-y", up="keep")[0] == replace(
        DEFAULT_WRITE_OPTIONS, up="z"
    )


def test_paths_are_in_the_frame_that_people_see(tmp_path: Path) -> None:
    """A path that the viewer saves has its cameras where they are in the frame, and comes back as
    it was recorded."""
    opened = open_run(edited(write_moving_run(tmp_path)))
    (camera,) = training_cameras(opened.capture.splits["train"][:1], opened.config.data)
    text = Recording((Keyframe(camera, 0.0),)).document((16, 16), 30.0, opened)
    (tmp_path / "path.json").write_text(text)
    pose = np.array(json.loads(text)["keyframes"][0]["cam_from_world"])
    centre = -pose[:3, :3].T @ pose[:3, 3]
    np.testing.assert_allclose(centre, opened.world.points(camera.centers[0].numpy()), atol=1e-5)
    back = choose_path(opened, PathOptions(str(tmp_path / "path.json"))).cameras
    torch.testing.assert_close(back.cam_from_world[0], camera.cam_from_world[0], rtol=0, atol=1e-5)


def test_edits_add_up_and_are_undone_to_the_bytes(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, offset=(100.0, 0.0, 0.0))
    once = edited(run, replace(EDITS, frame=replace(EDITS.frame, origin=(100.5, 0.25, 0.0))))
    np.testing.assert_allclose(
        open_run(once).frame.points(np.array([0.5, 0.25, 0.0])), 0, atol=1e-9
    )
    twice = open_run(edited(once, Edits(frame=Frame(scale=0.5, origin=(1.0, 2.0, 3.0))), "twice"))
    assert twice.frame.scale == pytest.approx(1.5)
    np.testing.assert_allclose(
        twice.world.points(open_run(once).frame.inverse().points(np.array([1.0, 2, 3]))),
        0,
        atol=1e-12,
    )
    assert twice.stated_up == "z"
    back = edited(tmp_path / "twice", Edits(undo=True), "back")
    assert open_run(back).edited is None
    first, last = (next((folder / "checkpoints").iterdir()).read_bytes() for folder in (run, back))
    assert first == last
    with pytest.raises(DyngsError, match="coordinate frame of this run was not changed"):
        edited(back, Edits(undo=True), "more")
    assert not (tmp_path / "more").exists()
