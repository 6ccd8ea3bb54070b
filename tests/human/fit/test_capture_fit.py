"""The fit of whole captures: a person of another shape than the given poses are for is found from
silhouettes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from smpl_like import write_capture_of, write_smpl_like

from dyngs.capture.fixed_camera import silhouettes_of
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.human.avatar.posing import Skeleton, frame_pose, posed_joints
from dyngs.human.body.body_reader import default_template, read_body, rest_shape
from dyngs.human.body.skinning import axis_angle_to_matrix, joint_transforms
from dyngs.human.fit.capture_fit import (
    MIN_GAIN,
    RESOLUTION,
    BodyFit,
    CandidateFit,
    CaptureFit,
    FitEffort,
    body_discs,
    collect_fitted_clips,
    fit_capture,
    place_new_poses,
    pose_prior,
    split_views,
)
from dyngs.human.fit.fitted_capture import apply_known_shape
from dyngs.human.motion.motion import captured_motion
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.io.write import write_image

OPTIONS = HumanOptions(
    size=96,
    num_frames=4,
    num_pose_frames=0,
    num_cameras=5,
    num_test=1,
    seed=1,
    samples=1,
    body_seed=5,
)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Capture]:
    """A capture with exact body parameters, and the same with the poses of the mean shape."""
    root = write_human_capture(tmp_path_factory.mktemp("fit") / "person", OPTIONS)
    exact = read_capture(DataConfig(root=root))
    arrays = dict(np.load(root / "body_train.npz"))
    np.savez(
        root / "body_train.npz",
        **(arrays | {"betas": np.zeros(10), "surface_model_type": np.array("smplx")}),
    )
    return exact, read_capture(DataConfig(root=root))


@lru_cache(maxsize=1)
def found(capture_root: Path) -> CaptureFit:
    capture = read_capture(DataConfig(root=capture_root))
    effort = FitEffort(side=64, steps=30, draws_per_frame=18)
    return fit_capture(
        capture, DataConfig(root=capture_root), default_template(), lambda *_: None, effort=effort
    )


def joints_of(capture: Capture, fit: CaptureFit | None) -> torch.Tensor:
    """(F, 22, 3) joints in the world, m: of the capture's own parameters, or of the fit."""
    body = default_template()
    assert capture.body is not None
    _, rest = rest_shape(body, capture.body["train"])
    clip = captured_motion(capture.root, capture.body["train"], capture.splits["train"], rest).clip
    if fit is not None:
        assert body.joint_shape_dirs is not None
        clip = fit.clip
        rest = body.joints + body.joint_shape_dirs @ fit.betas
    moves = joint_transforms(rest, body.parents, axis_angle_to_matrix(clip.poses))
    posed = (moves[..., :3] @ rest[..., None])[..., 0] + moves[..., 3]
    return (clip.scale[:, None, None] * posed + clip.trans[:, None])[:, :22]


def test_the_joints_come_nearer_to_the_truth(wrong: tuple[Capture, Capture]) -> None:
    exact, given = wrong
    truth = joints_of(exact, None)
    before, after = (
        (joints_of(given, fit) - truth).norm(dim=-1).mean() for fit in (None, found(given.root))
    )
    assert before > 0.03
    assert after < 0.5 * before


def test_a_body_file_finds_its_own_shape(
    smpl_files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A person of a file of 55 joints, wide as no mean; a file of 24 joints has the same shapes."""
    betas = torch.zeros(10)
    betas[:2] = torch.tensor([2.0, -1.5])
    options = HumanOptions(
        size=96, num_frames=2, num_pose_frames=0, num_cameras=5, num_test=1, seed=1, samples=1
    )
    root = write_capture_of(
        *write_smpl_like(tmp_path, "smplx"), tmp_path / "person", options, betas, monkeypatch
    )
    capture = read_capture(DataConfig(root=root))
    body = apply_known_shape(read_body(*smpl_files), None)
    assert capture.body is not None
    wrong = {split: replace(given, betas=np.zeros(10)) for split, given in capture.body.items()}
    effort = FitEffort(side=64, steps=30, draws_per_frame=6)
    fit = fit_capture(
        capture.replace(body=wrong), DataConfig(root=root), body, lambda *_: None, effort=effort
    )
    assert fit.chosen.iou > fit.candidates[0].iou + MIN_GAIN
    assert body.shape_dirs is not None
    truth, found = (body.vertices + body.shape_dirs @ x for x in (betas, fit.betas))
    size = float(fit.chosen.learned["log_scale"].detach())
    away, before = (
        (x - x.mean(0)) - (truth - truth.mean(0)) for x in (math.exp(size) * found, body.vertices)
    )
    assert away.norm(dim=1).mean() < 0.5 * before.norm(dim=1).mean()


def test_the_same_capture_gives_the_same_fit(wrong: tuple[Capture, Capture]) -> None:
    options = DataConfig(root=wrong[1].root)
    effort = FitEffort(side=32, steps=2, draws_per_frame=0)
    body = default_template()
    first, again = (
        fit_capture(wrong[1], options, body, lambda *_: None, effort=effort).chosen.learned
        for _ in range(2)
    )
    assert torch.equal(first["betas"], again["betas"])
    assert torch.equal(first["trans"], again["trans"])


def test_one_view_of_each_frame_is_left_out(wrong: tuple[Capture, Capture]) -> None:
    capture = wrong[1]
    views = capture.splits["train"]
    assert capture.body is not None
    motion = captured_motion(capture.root, capture.body["train"], views, default_template().joints)
    used, left_out = split_views(views, motion)
    assert sorted(i for rows in (*used.values(), *left_out.values()) for i in rows) == list(
        range(len(views))
    )
    assert [len(rows) for rows in left_out.values()] == [1, 1, 1, 1]
    assert len({views[rows[0]].name.split("_")[-1] for rows in left_out.values()}) == 4
    few, none = split_views(views[:4], motion)
    assert not any(none.values())
    assert few[0] == [0, 1, 2, 3]


def test_without_given_poses_every_frame_has_its_own(wrong: tuple[Capture, Capture]) -> None:
    body = default_template()
    assert wrong[1].body is not None
    motion = captured_motion(
        wrong[1].root, wrong[1].body["train"], wrong[1].splits["train"], body.joints
    )
    skeleton = Skeleton(body.joints, body.parents)
    joints = {}
    for row, frame in enumerate(motion.frames):
        positions = posed_joints(skeleton, frame_pose(motion.clip, row)).float()
        joints[frame] = torch.cat([positions, torch.ones_like(positions[:, :1])], dim=1)
    capture = wrong[1].replace(body=None)
    effort = FitEffort(side=32, steps=1, draws_per_frame=0)
    options = DataConfig(root=capture.root)
    fit = fit_capture(capture, options, body, lambda *_: None, effort=effort, joints=joints)
    assert fit.candidates[0].name == "frame-by-frame poses"
    assert fit.motion.frames == (0, 1, 2, 3)
    poses = fit.clip.poses
    assert len({tuple(pose.flatten().tolist()) for pose in poses}) == 4
    clips = collect_fitted_clips(capture, default_template(), fit, None)
    assert clips["train"].frames == (0, 1, 2, 3)
    assert torch.equal(clips["train"].clip.poses, poses)


def test_silhouettes_alone_are_refused(wrong: tuple[Capture, Capture]) -> None:
    """They do not show which way a person faces."""
    capture = wrong[1].replace(body=None)
    with pytest.raises(DyngsError, match=r"nor key points.*dyngs data people"):
        fit_capture(capture, DataConfig(root=capture.root), default_template(), print)


def test_masks_of_the_background_are_refused(
    wrong: tuple[Capture, Capture], tmp_path: Path
) -> None:
    given = wrong[0]
    views = []
    for view in given.splits["train"]:
        image = read_image(view.image_path).numpy()
        photo, mask = (tmp_path / name / f"{view.name}.png" for name in ("photos", "masks"))
        write_image(photo, image[..., :3])
        write_image(mask, 255 - image[..., 3:])
        views.append(
            replace(view, image_path=photo, silhouette=silhouettes_of(mask.parent, [mask.name])[0])
        )
    capture = given.replace(splits={**given.splits, "train": tuple(views)})
    with pytest.raises(DyngsError, match="seem to be inverted"):
        fit_capture(capture, DataConfig(root=capture.root), default_template(), print)


def test_images_without_silhouettes_are_refused(wrong: tuple[Capture, Capture]) -> None:
    with pytest.raises(DyngsError, match="no silhouettes"):
        fit_capture(
            wrong[1].replace(has_alpha=False),
            DataConfig(root=wrong[1].root),
            default_template(),
            print,
        )


TWO_CLIPS = HumanOptions(
    size=96, num_frames=2, num_pose_frames=2, num_cameras=4, num_test=4, seed=0, samples=1
)
EFFORT = FitEffort(side=64, steps=40)
AWAY = np.array([0.03, -0.02, 0.02])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return read_capture(
        DataConfig(root=write_human_capture(tmp_path_factory.mktemp("clip") / "ann", TWO_CLIPS))
    )


def as_given(capture: Capture) -> CaptureFit:
    """Return a fit that keeps the poses of the capture."""
    body = default_template()
    assert capture.body is not None
    motion = captured_motion(
        capture.root, capture.body["train"], capture.splits["train"], body.joints
    )
    fitting = BodyFit(
        motion.clip, body_discs(body, RESOLUTION), pose_prior(motion.clip, is_given=True)
    )
    candidate = CandidateFit("given poses", fitting.initial_parameters(), 0.9, (0.9, 0.9))
    return CaptureFit(motion, candidate, (candidate,), 0)


def moved(capture: Capture, away: np.ndarray) -> Capture:
    """The capture with the poses of its new clip away from where they are."""
    assert capture.body is not None
    given = capture.body["pose"]
    return capture.replace(
        body={**capture.body, "pose": replace(given, trans=given.trans + away.astype(np.float32))}
    )


def test_a_clip_that_stands_elsewhere_is_moved_to_its_silhouettes(capture: Capture) -> None:
    wrong = moved(capture, AWAY)
    fit = as_given(capture)
    body = default_template()
    found = place_new_poses(
        wrong, DataConfig(root=capture.root), body, fit, lambda *_: None, EFFORT
    )
    assert found is not None
    assert found.iou_moved is not None
    assert found.iou_moved > found.iou + 0.02
    assert "translation fitted" in found.summary()
    assert wrong.body is not None
    views = wrong.splits["pose"]
    given = captured_motion(wrong.root, wrong.body["pose"], views, body.joints).clip
    clip = collect_fitted_clips(wrong, body, fit, found)["pose"].clip
    shift = clip.trans - given.trans
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), atol=1e-6, rtol=0)
    assert np.abs(shift[0].numpy() + AWAY).max() < 0.008, (
        "mm that the drawn discs and the mesh differ by"
    )
    assert torch.equal(clip.poses, given.poses)
