"""A person found in a clip: the files for the fit, and the capture that comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from dyngs.capture.fixed_camera import read_fixed_camera
from dyngs.config import DataConfig
from dyngs.core.conventions import ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import read_body_file
from dyngs.data.capture import Capture, all_views
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.human.body.body_reader import default_template, rest_shape
from dyngs.human.detect import detect_person as module
from dyngs.human.detect.detect_person import (
    detect_person,
    ensure_detected_person,
    write_detected_person,
)
from dyngs.human.detect.detector import Detection
from dyngs.human.fit.fitted_capture import ensure_fitted_body, write_fitted_capture
from dyngs.human.fit.keypoints import JOINTS, read_keypoints
from dyngs.human.keys import HumanModel
from dyngs.human.kind import HUMAN
from dyngs.io.write import write_image
from tests.detections import person

HEIGHT, WIDTH, COUNT = 120, 160, 10


def truth(number: int) -> np.ndarray:
    """Mask (H, W) of somebody with legs apart who walks to the right."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    across = columns - (30 + 10 * number)
    trunk = (abs(across) < 12) & (rows > 20) & (rows < 70)
    legs = (abs(abs(across) - 8) < 4) & (rows >= 70) & (rows < 108)
    return trunk | legs | (across**2 + (rows - 14) ** 2 < 49)


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Images that ``Rough`` can read: red and green of the ground are column and row; blue of the
    person is the number of the image."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    for number in range(COUNT):
        ground = np.stack([columns, rows, 0 * rows], axis=-1)
        clothes = np.array([220.0, 200.0, 130 + 6 * number])
        image = np.where(truth(number)[..., None], clothes, ground)
        image += rng.normal(0, 1.5, image.shape)
        write_image(tmp_path / "clip" / f"f{number}.png", np.clip(image, 0, 255).astype(np.uint8))
    return tmp_path / "clip"


class Rough:
    """Finds the person with outlines that are 1 px off, and nobody in image 4."""

    name = "Rough"

    def __init__(self, nobody: bool = False) -> None:
        self.nobody = nobody

    def detect(self, images: Sequence[Path]) -> list[Detection | None]:
        return [self._walker(read_image(path).numpy().astype(np.float64)) for path in images]

    def _walker(self, pixels: np.ndarray) -> Detection | None:
        is_person = pixels[..., 2] > 60
        rows, columns = np.nonzero(~is_person)
        scale, left = np.polyfit(columns, pixels[rows, columns, 0], 1)
        top = float(np.mean(pixels[rows, columns, 1] - scale * rows))
        if self.nobody or not is_person.any():
            return None
        number = round((float(np.median(pixels[is_person, 2])) - 130) / 6)
        if number == 4:
            return None
        grown = (ndimage.binary_dilation, ndimage.binary_erosion)[number % 2](truth(number))
        at_rows = np.round(top + scale * np.arange(pixels.shape[0])).astype(int)
        at_columns = np.round(left + scale * np.arange(pixels.shape[1])).astype(int)
        mask = grown[at_rows.clip(0, HEIGHT - 1)][:, at_columns.clip(0, WIDTH - 1)]
        points = (person(30 + 10 * number, 90.0).keypoints - [left, top, 0]) / [scale, scale, 1]
        return Detection(points.astype(np.float32), (255 * mask).astype(np.uint8))


def capture_of(clip: Path) -> Capture:
    return read_fixed_camera(DataConfig(root=clip))


def overlap(folder: Path, number: int) -> float:
    found = read_image(folder / f"f{number}.png")[..., 0].numpy() > 127
    return float((found & truth(number)).sum() / (found | truth(number)).sum())


@pytest.mark.parametrize("side", [960, 80])
def test_masks_and_key_points_of_all_views(
    clip: Path, tmp_path: Path, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "DETECTOR_SIDE_PX", side)
    said: list[str] = []
    found = detect_person(
        capture_of(clip), Rough(), tmp_path / "found", ignore_progress, said.append
    )
    assert found.masks is not None
    assert found.keypoints is not None
    seen = [number for number in range(COUNT) if number != 4]
    # The removal of single pixels rounds corners of legs 8 px wide. 80: at half the size.
    assert min(overlap(found.masks, number) for number in seen) > (0.92 if side == 960 else 0.7)
    assert overlap(found.masks, 4) == 0
    points = read_keypoints(found.keypoints, capture_of(clip).splits["train"])
    assert set(points) == {f"f{number}" for number in seen}
    ankle = points["f2"][JOINTS["left_ankle"]].numpy()
    np.testing.assert_allclose(ankle, person(50, 90.0).keypoints[15], atol=1.0)
    assert any("detected the person" in line and "in 9 of 10 images" in line for line in said)
    assert not list((tmp_path / "found" / "crops").iterdir()), (
        "images for the detector only live while it runs"
    )


def test_nobody_is_an_error(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="Rough detects nobody in 10 images"):
        detect_person(
            capture_of(clip), Rough(nobody=True), tmp_path / "found", ignore_progress, [].append
        )


def test_a_camera_in_which_nobody_is_found_is_left_out(clip: Path, tmp_path: Path) -> None:
    capture = capture_of(clip)
    first = list(capture.splits["train"])
    dark = tmp_path / "dark.png"
    write_image(dark, read_image(clip / "f4.png").numpy() * np.array([1, 1, 0], np.uint8))
    others = [
        replace(view, camera_id=1, name=f"other_{view.name}", image_path=dark) for view in first
    ]
    said: list[str] = []
    both = capture.replace(splits={"train": (*first, *others)})
    found = detect_person(both, Rough(), tmp_path / "found", ignore_progress, said.append)
    assert "warning: camera 1: Rough detects nobody; skipping its images" in said
    assert found.masks is not None
    assert not any(read_image(found.masks / f"{view.name}.png").any() for view in others)
    assert overlap(found.masks, 2) > 0.92


def test_a_capture_of_the_person_comes_out(clip: Path, tmp_path: Path, short_fits: None) -> None:
    out = tmp_path / "ann"
    result = write_detected_person(
        DataConfig(root=clip, frames="0:10:4"), out, Rough(), log=[].append
    )
    assert result.root == out
    capture = read_capture(DataConfig(root=out))
    assert capture.body is not None
    assert capture.has_alpha
    assert len(all_views(capture.splits)) == 2, "the image without anybody is left out"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ann", "clip"], (
        "nothing else is left behind"
    )
    with pytest.raises(DyngsError, match=r"exists|not empty"):
        write_detected_person(DataConfig(root=clip), out, Rough(), log=[].append)


def test_silhouettes_of_the_images_are_kept(clip: Path, tmp_path: Path, short_fits: None) -> None:
    """The detector's are 1 px off."""
    for number in range(COUNT):
        image = read_image(clip / f"f{number}.png").numpy()
        alpha = (255 * truth(number)).astype(np.uint8)[..., None]
        write_image(tmp_path / "rgba" / f"f{number}.png", np.concatenate([image, alpha], axis=2))
    options = DataConfig(root=tmp_path / "rgba", frames="0:4")
    said: list[str] = []
    write_detected_person(options, tmp_path / "ann", Rough(), log=said.append)
    assert "using the silhouettes of the images; only key points are detected" in said
    views = all_views(read_capture(DataConfig(root=tmp_path / "ann")).splits)
    areas = [int((read_image(view.image_path)[..., 3] > 127).sum()) for view in views]
    assert areas == [int(truth(number).sum()) for number in range(4)]


def test_pictures_are_copied_into_a_run(tmp_path: Path) -> None:
    """Not those that link to files elsewhere."""
    root = tmp_path / "capture"
    write_image(root / "detection.png", np.zeros((2, 2, 3), np.uint8))
    (root / "detection.png").chmod(0o444)
    (tmp_path / "secret").write_text("x")
    (root / "people.png").symlink_to(tmp_path / "secret")
    folder = tmp_path / "pictures"
    for _ in range(2):  # a run may begin again
        HUMAN.copy_pictures(DataConfig(root=root), folder)
    assert [path.name for path in folder.iterdir()] == ["detection.png"]
    assert folder.joinpath("detection.png").stat().st_mode & 0o200


def test_the_stature_scales_the_person_about_the_camera(
    clip: Path, tmp_path: Path, short_fits: None
) -> None:
    template = default_template()
    bodies = []
    for stature in (1.5, 1.8):
        out = tmp_path / f"ann{stature}"
        options = DataConfig(root=clip, frames="0:10:4", stature=stature)
        write_detected_person(options, out, Rough(), log=[].append)
        body = read_body_file(out / "body_train.npz")
        vertices, _ = rest_shape(template, body)
        height = float(vertices[:, 1].max() - vertices[:, 1].min())
        assert height * body.scale == pytest.approx(stature, rel=1e-4)
        bodies.append(body)
    np.testing.assert_allclose(bodies[1].trans, 1.2 * bodies[0].trans, rtol=1e-4)
    np.testing.assert_array_equal(bodies[1].poses, bodies[0].poses)
    fitted = DataConfig(root=out, stature=1.8)
    with pytest.raises(DyngsError, match=r"data.stature=1.8: the size .* is known"):
        write_fitted_capture(fitted, tmp_path / "again", ignore_progress)
    with pytest.raises(DyngsError, match=r"data.stature=1.8: the size .* is known"):
        ensure_fitted_body(fitted)


def test_a_clip_is_looked_at_once(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DYNGS_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "MediaPipe", Rough)
    made: list[Path] = []

    def write(options: DataConfig, out: Path, *_: object) -> SimpleNamespace:
        assert options.root == clip
        out.mkdir(parents=True)
        made.append(out)
        return SimpleNamespace(summary="fitted")

    monkeypatch.setattr(module, "write_detected_person", write)
    said: list[str] = []
    for frames in ("0:8", "0:8", "0:4"):
        data = ensure_detected_person(DataConfig(root=clip, frames=frames), log=said.append)
        assert (data.root, data.frames) == (made[-1], None)
    assert len(made) == 2
    assert [line for line in said if "using the cached result" in line] == [said[2]]


def test_a_number_that_nobody_has_is_refused(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="there is no person 3; Rough found 1, so give a number"):
        detect_person(
            capture_of(clip), Rough(), tmp_path / "found", ignore_progress, [].append, person=3
        )


def test_a_person_cannot_be_chosen_in_a_capture_with_cameras(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text("{}")
    data = DataConfig(root=tmp_path, format="body_json", person=2)
    with pytest.raises(DyngsError, match=r"data.person=2: only clips .* --person 2"):
        HUMAN.find_body(data, HumanModel(), [].append, ignore_progress)
