"""The shape of a known person: which file it is read from, how it changes the template, and which
files are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_bodies import model, write_npz
from torch import Tensor

from dyngs.config import Config, DataConfig, OptimConfig, RunConfig, TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.human.avatar import pose_fit
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit.fitted_capture import (
    AvatarPoseFit,
    KnownAvatar,
    apply_known_shape,
    fit_poses_by_avatar,
    known_betas,
    read_known_shape,
)
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import CapturedMotion, MotionClip
from dyngs.io.write import write_image
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer


def fitted(folder: Path, kind: str = "anny") -> Path:
    folder.mkdir()
    betas = np.linspace(-1, 1, default_template().num_shapes)
    parts = {
        "poses": np.zeros((2, 165)),
        "trans": np.zeros((2, 3)),
        "betas": betas,
        "surface_model_type": kind,
    }
    np.savez(folder / "body_train.npz", **parts)  # pyright: ignore[reportArgumentType]
    return folder


def test_the_template_gets_the_shape(tmp_path: Path) -> None:
    body = default_template()
    known = read_known_shape(fitted(tmp_path / "a"), body)
    shaped = apply_known_shape(body, known)
    betas = known_betas(body, known)
    assert body.joint_shape_dirs is not None
    assert torch.allclose(shaped.joints, body.joints + body.joint_shape_dirs @ betas, atol=1e-5)
    assert betas[-1] == 1
    assert shaped.num_shapes == body.num_shapes


def test_others_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no fitted body"):
        read_known_shape(tmp_path, default_template())
    with pytest.raises(DyngsError, match="another template than"):
        read_known_shape(fitted(tmp_path / "b", "smplx"), default_template())


def test_a_body_of_smpl_has_the_first_ten_shapes(tmp_path: Path) -> None:
    body = read_body(write_npz(tmp_path / "x.npz", model("smplx", directions=30)))
    cut = apply_known_shape(body, None)
    assert (body.num_shapes, cut.num_shapes) == (30, 10)
    assert torch.equal(cut.vertices, body.vertices)
    assert apply_known_shape(default_template(), None).num_shapes == default_template().num_shapes


SIZE = 64
TURNED = ("left_hip", "right_knee", "left_shoulder", "right_elbow")
AWAY = torch.tensor([0.03, 0.0, 0.02])


@pytest.fixture(scope="module")
def avatar(person: Path) -> HumanScene:
    """A person of a few hundred Gaussians, which was not trained."""
    scene = new_trainer(person).model.scene
    assert isinstance(scene, HumanScene)
    return scene


def new_trainer(person: Path) -> Trainer:
    model = HumanModel(resolution=24, sh_degree=0)
    train = TrainConfig(steps=10)
    run = RunConfig(threads=1)
    return build_trainer(
        Config(data=DataConfig(root=person), model=model, optim=OptimConfig(), train=train, run=run)
    )


@pytest.fixture(scope="module")
def views(avatar: HumanScene, person: Path, tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    """The avatar in two of the three frames of its clip from three cameras; its colours are
    noise."""
    folder = tmp_path_factory.mktemp("drawn")
    found = []
    images = new_trainer(person).images
    cameras = {tuple(p.cameras.cam_from_world.flatten().tolist()): p.cameras for p in images}
    for frame, time in enumerate(avatar.times[:2]):
        for i, camera in enumerate(cameras.values()):
            larger = torch.tensor([SIZE / 32, SIZE / 32, 1.0])[:, None] * camera.intrinsics
            with torch.no_grad():
                drawn = avatar.render(
                    replace(camera, intrinsics=larger, width=SIZE, height=SIZE), time
                )
            image = torch.cat([torch.rand(SIZE, SIZE, 3), drawn.alpha[0].clamp(0, 1)[..., None]], 2)
            path = folder / f"{frame}_{i}.png"
            write_image(path, (image.numpy() * 255).round().astype(np.uint8))
            pose = camera.cam_from_world[0].double().numpy()
            intrinsics = larger[0].double().numpy()
            found.append(
                View(path.stem, path, pose, intrinsics, SIZE, SIZE, camera_id=i, frame=frame)
            )
    return found


def posed(avatar: HumanScene, views: list[View], clip: MotionClip) -> AvatarPoseFit:
    start = CapturedMotion(clip, (0, 1, 2))
    return fit_poses_by_avatar(KnownAvatar(avatar, None), views, DataConfig(root=Path()), start)


def turned(clip: MotionClip) -> MotionClip:
    """The clip with some joints turned by 9 degrees about some axis, 36 mm from where it was."""
    rows = [JOINT_NAMES.index(name) for name in TURNED]
    poses = clip.poses.clone()
    away = torch.randn(len(clip), len(rows), 3, generator=torch.Generator().manual_seed(2))
    poses[:, rows] += 0.15 * away / away.norm(dim=2, keepdim=True)
    return replace(clip, poses=poses, trans=clip.trans + AWAY)


def error(clip: MotionClip, truth: MotionClip) -> Tensor:
    """Distances (3,) of the pelvis from where it is, m."""
    return (clip.trans - truth.trans).norm(dim=1)


def test_disturbed_poses_are_found_again(
    avatar: HumanScene, views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 4)
    start = turned(avatar.clip)
    found = posed(avatar, views, start)
    assert found.num_held_out == 2
    assert found.after > found.before + 0.1
    assert "used; silhouette IoU on 2 held-out views" in found.summary()
    after = found.clip.clip
    assert error(after, avatar.clip)[:2].max() < 0.025 < error(start, avatar.clip).min()
    assert torch.equal(after.poses[2], start.poses[2]), "no image shows that frame"
    assert torch.equal(after.times, start.times)


def test_worse_poses_are_rejected(
    avatar: HumanScene, views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Held-out views that show another person, who does not move, outvote the training views."""
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 2)
    start = replace(avatar.clip, trans=avatar.clip.trans + AWAY)
    first = {view.frame: view for view in reversed(views)}
    others = [view for view in views if view not in first.values()]
    moved = [
        replace(view, cam_from_world=_shifted(view.cam_from_world, -AWAY))
        for view in first.values()
    ]
    found = posed(avatar, [*others, *moved], start)
    assert found.clip.clip is start
    assert found.after <= found.before


def _shifted(cam_from_world: np.ndarray, by: Tensor) -> np.ndarray:
    """A camera that sees the world moved by ``by``."""
    shift = np.eye(4)
    shift[:3, 3] = by.numpy()
    return cam_from_world @ shift
