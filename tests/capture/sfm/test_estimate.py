"""Structure from motion against the exact poses of the demo scene, and on a real capture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from skimage.transform import ProjectiveTransform, resize_local_mean, warp
from tiny_captures import write_colmap

from dyngs.api.load import read_capture
from dyngs.capture.sfm import estimate
from dyngs.capture.sfm.colmap import SfmOptions
from dyngs.capture.sfm.estimate import SfmModel, SfmResult, choose_better_model, estimate_poses
from dyngs.core.errors import DyngsError
from dyngs.data.capture import all_views
from dyngs.data.synthetic.captures import orbit_cameras, render_scene, still_life
from dyngs.export.video import video_writer
from dyngs.io.write import write_image

FAST = SfmOptions(num_threads=1)


def _still_arc(count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """OpenGL poses on an arc of 7 degrees per step, and their images on grey."""
    poses = orbit_cameras(360 // 7, 4.0, elevation_deg=40.0, start_deg=200.0)[:count]
    rgba = [render_scene(still_life(), pose, 320, samples=2) / 255.0 for pose in poses]
    return poses, [
        ((x[..., :3] * x[..., 3:] + 0.5 * (1 - x[..., 3:])) * 255).astype(np.uint8) for x in rgba
    ]


def _rotation_errors_deg(result: SfmResult, truth: dict[str, np.ndarray]) -> np.ndarray:
    """Angles between estimated and true rotations relative to the first image."""
    model = pycolmap.Reconstruction(str(result.root / "sparse" / "0"))
    found = {
        image.name: image.cam_from_world().rotation.matrix() for image in model.images.values()
    }
    names = sorted(found)
    errors = []
    for name in names[1:]:
        estimated = found[name] @ found[names[0]].T
        expected = truth[name] @ truth[names[0]].T
        cosine = 0.5 * (np.trace(estimated @ expected.T) - 1)
        errors.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return np.array(errors)


def test_poses_of_the_demo_scene_are_found_from_a_video(tmp_path: Path) -> None:
    poses, images = _still_arc(8)
    with video_writer(tmp_path / "arc.mp4", fps=10, quality=8) as add:
        for rgb in images:
            blurred = (np.roll(rgb, 1, axis=0) // 2 + rgb // 2).astype(np.uint8)
            add(blurred)
            add(rgb)
    out = tmp_path / "capture"
    options = SfmOptions(num_threads=1, num_frames=8)
    told: dict[str, tuple[int, int]] = {}
    result = estimate_poses(
        tmp_path / "arc.mp4",
        out,
        options,
        lambda what, done, total: told.update({what: (done, total)}),
    )
    assert told == {
        "frames of the video": (8, 8),
        "features, images": (8, 8),
        "matching, pairs": (28, 28),
        "poses, images": (result.num_registered, 8),
    }
    assert result.root == out
    assert result.num_images == 8
    assert result.num_registered >= 7, result.summary()
    names = sorted(p.name for p in (out / "images").iterdir())
    assert names == [f"frame_{2 * i + 1:05d}.png" for i in range(8)], (
        "of each window the sharper image"
    )
    flip = np.diag([1.0, -1.0, -1.0])
    truth = {name: (pose[:3, :3] @ flip).T for name, pose in zip(names, poses, strict=True)}
    # An arc of 49 degrees fixes the focal length, and with it the angle, to some 5%.
    assert _rotation_errors_deg(result, truth).max() < 4.0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arc.mp4", "capture"]
    assert sorted(p.name for p in out.iterdir()) == [
        "images",
        "sparse",
        "times.json",
    ]
    seconds = {view.name: view.time for view in all_views(read_capture(out).splits)}
    registered = [i for i, name in enumerate(names) if name.removesuffix(".png") in seconds]
    first = registered[0]
    last = registered[-1]
    for i in registered:
        assert seconds[names[i].removesuffix(".png")] == pytest.approx((i - first) / (last - first))
    assert read_capture(out).seconds == pytest.approx(0.2 * (last - first)), (
        "every second frame of 10 per second"
    )


def test_real_photos_register_and_repeat_bytewise(tmp_path: Path) -> None:
    images = Path(__file__).parents[3] / "../shared/data/colmap_small/images"
    if not images.is_dir():
        pytest.skip("the shared capture colmap_small is not here")
    for i, name in enumerate(("1", "3", "4", "5", "2", "6", "18", "7")):
        pixels = oiio.ImageBuf(str(images / f"{name}.jpg")).get_pixels(oiio.FLOAT)
        folder = tmp_path / "photos" / ("a" if i < 4 else "b")
        write_image(folder / f"{name}.png", resize_local_mean(pixels, (300, 400)))
    results = [
        estimate_poses(tmp_path / "photos", tmp_path / name, FAST) for name in ("first", "second")
    ]
    assert results[0].num_registered == 8, results[0].summary()
    assert results[0].mean_error_px < 1.0, results[0].summary()
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        first, second = (result.root / "sparse" / "0" / file for result in results)
        assert first.read_bytes() == second.read_bytes(), file
    assert (tmp_path / "first" / "images" / "a" / "1.png").is_file(), "subfolders are kept"


def test_nothing_to_register_gives_advice_and_no_folder(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(3):
        write_image(
            tmp_path / "photos" / f"{i}.png", rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
        )
    with pytest.raises(DyngsError, match="overlap"):
        estimate_poses(tmp_path / "photos", tmp_path / "out", FAST)
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


def test_a_camera_that_rotates_on_the_spot_is_refused(tmp_path: Path) -> None:
    scene = gaussian_filter(np.random.default_rng(0).uniform(size=(400, 800)), 2.0)
    scene = (scene - scene.min()) / np.ptp(scene)
    lens = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    for i in range(4):
        turn = Rotation.from_euler("y", 6 * i - 9, degrees=True).as_matrix()
        seen = np.array([[1.0, 0, 240], [0, 1, 80], [0, 0, 1]]) @ lens @ turn @ np.linalg.inv(lens)
        image = warp(scene, ProjectiveTransform(seen), output_shape=(240, 320))
        write_image(tmp_path / "photos" / f"{i}.png", np.repeat(image[..., None], 3, axis=2))
    with pytest.raises(DyngsError, match="the camera only rotated"):
        estimate_poses(tmp_path / "photos", tmp_path / "out", FAST)


def test_masks_beside_the_photos_are_read_and_links_out_of_their_folder_are_not(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(0)
    for i in range(3):
        write_image(
            tmp_path / "photos" / f"{i}.png", rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
        )
        write_image(tmp_path / "masks" / f"{i}.png", np.full((64, 64, 1), 255, np.uint8))
    options = replace(FAST, masks=tmp_path / "masks")
    with pytest.raises(DyngsError, match="overlap"):
        # as without masks: nothing in them fits together
        estimate_poses(tmp_path / "photos", tmp_path / "out", options)
    (tmp_path / "masks" / "0.png").rename(tmp_path / "private.png")
    (tmp_path / "masks" / "0.png").symlink_to("../private.png")
    with pytest.raises(DyngsError, match=r"0\.png: points to .*private\.png"):
        estimate_poses(tmp_path / "photos", tmp_path / "out", options)


def test_bad_requests_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no such"):
        estimate_poses(tmp_path / "none", tmp_path / "out")
    photos = tmp_path / "photos"
    write_image(photos / "a.png", np.zeros((8, 8, 3)))
    with pytest.raises(DyngsError, match="1 image"):
        estimate_poses(photos, tmp_path / "out")
    with pytest.raises(DyngsError, match="exists already"):
        estimate_poses(photos, photos)
    (photos / "b.png").write_text("no image")
    write_image(photos / "c.png", np.zeros((8, 8, 3)))
    with pytest.raises(DyngsError, match=r"b\.png"):
        estimate_poses(photos, tmp_path / "out")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(DyngsError, match=r"text\.mp4"):
        estimate_poses(tmp_path / "text.mp4", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["photos", "text.mp4"]


def _model(focal: float, known: bool = False) -> SfmModel:
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, 480, 270)
    camera.has_prior_focal_length = known
    found.add_camera(camera)
    return SfmModel(found, 1.0)


@pytest.mark.parametrize(
    ("focal", "known", "real"), [(400, False, True), (6100, False, False), (6100, True, True)]
)
def test_a_focal_length_of_many_widths_is_no_lens_unless_exif_says_so(
    focal: float, known: bool, real: bool
) -> None:
    assert _model(focal, known).has_real_lens == real


def test_the_model_with_a_real_lens_is_taken() -> None:
    real = _model(400)
    unreal = _model(6100)
    assert choose_better_model(unreal, real) is real
    assert choose_better_model(real, unreal) is real


def test_images_that_observe_no_points_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate, "_FEWEST_OBSERVED", 5)
    model = pycolmap.Reconstruction(str(write_colmap(tmp_path) / "sparse" / "0"))
    name = model.images[3].name
    model.delete_observation(3, 0)
    assert estimate.drop_unobserving_images(model) == [name]
    assert model.num_reg_images() == 8
