"""What a fit may begin with: a plain clip, masks of a folder, frames without anybody."""

from pathlib import Path

import numpy as np
import pytest

from dyngs.config import DataConfig
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.files.write import write_image
from dyngs.human.fit.inputs import FitInputs, has_guessed_lens, read_person, with_lens
from dyngs.human.fit.solve import LensFit
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture


def clip(folder: Path, empty: int = 2, count: int = 12) -> Path:
    """A block that crosses the image; nobody in the first frames."""
    ground = np.random.default_rng(0).uniform(80, 180, (5, 9, 3)).repeat(10, 0).repeat(10, 1).astype(np.uint8)
    for i in range(count):
        image = ground.copy()
        if i >= empty:
            image[10:40, 7 * (i - empty) : 7 * (i - empty) + 12] = [250, 240, 20]
        write_image(folder / f"f{i:02d}.png", image)
    return folder


def test_a_plain_clip_gets_masks_and_loses_empty_frames(tmp_path: Path) -> None:
    said: list[str] = []
    capture = read_person(DataConfig(root=clip(tmp_path / "c")), FitInputs(), tmp_path / "m", said.append)
    assert has_guessed_lens(capture)
    assert capture.has_alpha
    assert [view.name for view in capture.splits["train"]] == [f"f{i:02d}" for i in range(2, 12)]
    assert any("2 frames in which hardly anybody is seen are left out, first f00" in line for line in said)


def test_a_refined_lens_moves_the_cameras(tmp_path: Path) -> None:
    capture = read_person(DataConfig(root=clip(tmp_path / "c")), FitInputs(), tmp_path / "m", lambda _: None)
    lens = LensFit(1.5, 3.0, (0.2, 0.1), True)
    before, after = (c.splits["train"][0] for c in (capture, with_lens(capture, lens)))
    assert after.intrinsics[0, 0] == 1.5 * before.intrinsics[0, 0]
    assert after.cam_from_world[2, 3] == pytest.approx(1.5)
    assert with_lens(capture, LensFit(1.5, 3.0, (0.1, 0.1), False)) is capture
    assert with_lens(capture, None) is capture


def test_masks_of_a_folder_replace_those_of_a_capture(tmp_path: Path) -> None:
    options = HumanOptions(size=32, num_frames=2, num_new=0, num_cameras=2, num_test=0, seed=1, samples=1)
    root = write_human_capture(tmp_path / "person", options)
    given = read_capture(DataConfig(root=root, test_every=0))
    for view in given.splits["train"]:
        write_image(tmp_path / "m" / f"{view.name}.png", np.full((32, 32, 1), 255, np.uint8))
    capture = read_person(DataConfig(root=root, test_every=0), FitInputs(masks=tmp_path / "m"), tmp_path / "w")
    assert not has_guessed_lens(capture)
    assert all(view.silhouette is not None for view in capture.splits["train"])
    (tmp_path / "m" / f"{given.splits['train'][0].name}.png").unlink()
    with pytest.raises(DyngsError, match="no mask for 1 of 4 images"):
        read_person(DataConfig(root=root, test_every=0), FitInputs(masks=tmp_path / "m"), tmp_path / "w")


def test_no_capture_and_no_clip_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no capture found"):
        read_person(DataConfig(root=tmp_path), FitInputs(), tmp_path / "m")
    with pytest.raises(DyngsError, match="no such folder"):
        read_person(DataConfig(root=tmp_path / "none.mp4"), FitInputs(), tmp_path / "m")
