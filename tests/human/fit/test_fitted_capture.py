"""The fit before training: when it runs, and that it runs once."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.capture.fixed_camera import FORMAT
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import read_body_file, transform_body
from dyngs.data.images.images import read_image
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.readers.transforms import read_frame_file, read_views
from dyngs.human.body.body_reader import load_template, rest_shape
from dyngs.human.fit.fitted_capture import (
    FitInputs,
    ensure_fitted_body,
    read_person_capture,
    write_body_file,
    write_fitted_capture,
    write_split,
)
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import captured_motion
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.io.write import write_image


@pytest.fixture(scope="module")
def person_of_zeros(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture whose poses are labelled as those of the mean shape of another template."""
    options = HumanOptions(
        size=32, num_frames=2, num_pose_frames=2, num_cameras=3, num_test=1, samples=1, body_seed=3
    )
    root = write_human_capture(tmp_path_factory.mktemp("fit") / "person", options)
    for name in ("train", "pose"):
        arrays = dict(np.load(root / f"body_{name}.npz"))
        arrays |= {"betas": np.zeros(10), "surface_model_type": np.array("smplx")}
        np.savez(root / f"body_{name}.npz", **arrays)
    return root


@pytest.fixture
def data(person_of_zeros: Path, tmp_path: Path, short_fits: None) -> DataConfig:
    """A copy of it, an empty cache, and fits of two steps."""
    return DataConfig(root=Path(shutil.copytree(person_of_zeros, tmp_path / "person")))


def test_a_capture_is_fitted_once(data: DataConfig) -> None:
    said: list[str] = []
    fitted = ensure_fitted_body(data, log=said.append)
    assert fitted.body is not None
    assert {path.name for path in fitted.body.iterdir()} == {
        *("body_train.npz", "body_pose.npz", "fit_report.json", "fit_overlays.png")
    }
    body = read_capture(fitted).body
    assert body is not None
    assert {split: frames.shape_space for split, frames in body.items()} == dict.fromkeys(
        ("train", "val", "test", "pose"), "anny"
    )
    assert "fitting" in said[0]
    again = ensure_fitted_body(data, log=said.append)
    assert again == fitted
    assert "using the cached fit" in said[-1]


@pytest.fixture
def smpl(smpl_files: tuple[Path, Path]) -> HumanModel:
    """Names a body file of 24 joints."""
    return HumanModel(body=smpl_files[0], uv=smpl_files[1])


def test_a_fit_is_fitted_again_only_for_another_template(
    data: DataConfig, smpl: HumanModel, tmp_path: Path
) -> None:
    out = write_fitted_capture(
        data, tmp_path / "fitted", lambda *_: None, FitInputs(template=smpl)
    ).root
    given = DataConfig(root=out)
    said = list[str]()
    assert ensure_fitted_body(given, smpl, log=pytest.fail) == given
    assert ensure_fitted_body(given, log=said.append) != given
    assert "fitting" in said[0]
    named = data.model_copy(update={"body": out})
    said = []
    assert ensure_fitted_body(named, smpl, log=pytest.fail) == named
    assert ensure_fitted_body(named, log=said.append) == named
    assert "was fitted with another template; using its poses, not its shape" in said[0]


def test_the_fit_begins_with_a_given_shape_of_the_template(
    data: DataConfig, smpl: HumanModel, tmp_path: Path
) -> None:
    betas = np.zeros(300)
    betas[:10] = np.linspace(-1, 1, 10)
    for name in ("train", "pose"):
        path = data.root / f"body_{name}.npz"
        np.savez(
            path,
            **(dict(np.load(path)) | {"betas": betas}),  # pyright: ignore[reportArgumentType]
        )
    found = write_fitted_capture(
        data, tmp_path / "fitted", lambda *_: None, FitInputs(template=smpl)
    )
    with np.load(tmp_path / "fitted" / "body_train.npz") as file:
        assert np.allclose(file["betas"], betas[:10] + found.fit.betas.numpy(), atol=1e-6)
    body = load_template(smpl)
    given = read_capture(data).body
    assert given is not None
    _, joints = rest_shape(body, given["train"])
    clip = captured_motion(
        data.root, given["train"], read_capture(data).splits["train"], joints
    ).clip
    assert torch.equal(found.fit.motion.clip.trans, clip.trans), "of the shaped body"


def test_a_fitted_capture_shows_the_same_person(data: DataConfig, tmp_path: Path) -> None:
    """Images are cropped to the person, so that pixels keep their rays."""
    out = write_fitted_capture(data, tmp_path / "fitted", lambda *_: None).root
    before = read_capture(data)
    after = read_capture(DataConfig(root=out))
    for split in ("train", "test", "pose"):
        assert len(after.splits[split]) == len(before.splits[split])
        ordered = sorted(before.splits[split], key=lambda view: view.frame or 0)
        for old, new in zip(
            ordered, sorted(after.splits[split], key=lambda view: view.frame or 0), strict=True
        ):
            assert old.time == new.time
            assert new.width * new.height <= old.width * old.height
            left, top = np.round(old.intrinsics[:2, 2] - new.intrinsics[:2, 2]).astype(int)
            shifted = old.intrinsics.copy()
            shifted[:2, 2] -= [left, top]
            assert np.allclose(shifted, new.intrinsics)
            whole = read_image(old.image_path).numpy()
            kept = whole[top : top + new.height, left : left + new.width]
            assert np.array_equal(kept, read_image(new.image_path).numpy())
            assert kept[..., 3].sum() == whole[..., 3].sum(), "nothing of the person is cut off"
    assert not list(tmp_path.glob(".fitted*")), "nothing is left beside it"


def clip(folder: Path, empty: int = 2, count: int = 12) -> Path:
    """A block that crosses the image; nobody in the first frames."""
    ground = (
        np.random.default_rng(0)
        .uniform(80, 180, (10, 18, 3))
        .repeat(5, 0)
        .repeat(5, 1)
        .astype(np.uint8)
    )
    for i in range(count):
        image = ground.copy()
        if i >= empty:
            image[10:40, 7 * (i - empty) : 7 * (i - empty) + 12] = [250, 240, 20]
        write_image(folder / f"f{i:02d}.png", image)
    return folder


def test_a_plain_clip_gets_masks_and_loses_empty_frames(tmp_path: Path) -> None:
    said: list[str] = []
    capture = read_person_capture(
        DataConfig(root=clip(tmp_path / "c")), FitInputs(), tmp_path / "m", said.append
    )
    assert capture.format == FORMAT
    assert capture.has_alpha
    assert [view.name for view in capture.splits["train"]] == [f"f{i:02d}" for i in range(2, 12)]
    assert any("skipped 2 views with (almost) empty masks, first f00" in line for line in said)


def test_photos_and_found_masks_are_written_apart(tmp_path: Path) -> None:
    capture = read_person_capture(
        DataConfig(root=clip(tmp_path / "c")), FitInputs(), tmp_path / "m", lambda _: None
    )
    views = capture.splits["train"]
    images = ImageLoader(views)
    rows = {view.frame: row for row, view in enumerate(views) if view.frame is not None}
    write_split(tmp_path / "out", "train", rows, capture, DataConfig(root=tmp_path), {})
    found, _ = read_views(read_frame_file(tmp_path / "out/transforms_train.json"))
    assert len(found) == len(views)
    for i, view in enumerate(found.values()):
        assert np.array_equal(read_image(view.image_path), read_image(views[i].image_path))
        alpha = ImageLoader([view])[0].alpha
        before = images[i].alpha
        assert alpha is not None
        assert before is not None
        assert torch.equal(alpha, before)
        assert 0 < float(alpha.mean()) < 0.5


def test_masks_of_a_folder_replace_those_of_a_capture(tmp_path: Path) -> None:
    options = HumanOptions(
        size=32, num_frames=2, num_pose_frames=0, num_cameras=2, num_test=0, seed=1, samples=1
    )
    root = write_human_capture(tmp_path / "person", options)
    given = read_capture(DataConfig(root=root, test_every=0))
    for view in given.splits["train"]:
        write_image(tmp_path / "m" / f"{view.name}.png", np.full((32, 32, 1), 255, np.uint8))
    capture = read_person_capture(
        DataConfig(root=root, test_every=0), FitInputs(masks=tmp_path / "m"), tmp_path / "w"
    )
    assert capture.format != FORMAT
    assert all(view.silhouette is not None for view in capture.splits["train"])
    (tmp_path / "m" / f"{given.splits['train'][0].name}.png").unlink()
    with pytest.raises(DyngsError, match="no mask for 1 of 4 images"):
        read_person_capture(
            DataConfig(root=root, test_every=0), FitInputs(masks=tmp_path / "m"), tmp_path / "w"
        )


def test_a_fit_far_from_the_origin_is_written_exactly(data: DataConfig, tmp_path: Path) -> None:
    capture = read_capture(data)
    body = load_template(HumanModel())
    assert capture.body is not None
    clip = captured_motion(data.root, capture.body["train"], capture.splits["train"], body.joints)
    offset = np.array([500_000.0, 4_600_000.0, 120.0])
    far = capture.replace(world_offset=offset, world_scale=0.25)
    write_body_file(tmp_path / "body.npz", clip, body, np.zeros(10), far)
    near = transform_body(read_body_file(tmp_path / "body.npz"), offset, 4.0)
    np.testing.assert_allclose(near.trans, clip.clip.trans.numpy(), rtol=0, atol=1e-8)
    np.testing.assert_array_equal(near.scale, clip.clip.scale.numpy())
