"""Videos: what goes in comes out, whole files only."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.container import OutputContainer
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core.errors import DyngsError
from dyngs.data.images.video import read_frames
from dyngs.export.video import VideoWriter


def _image(height: int, width: int, shift: int = 0) -> np.ndarray:
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[: height // 2] = [200, 30, 60]
    rgb[height // 2 :] = [20, 220, 90]
    return np.roll(rgb, shift, axis=0)


@settings(max_examples=8, deadline=None)
@given(st.integers(60, 91), st.integers(16, 51), st.sampled_from([10.0, 23.976, 60.0]))
def test_images_survive(
    tmp_path_factory: pytest.TempPathFactory, height: int, width: int, fps: float
) -> None:
    file = tmp_path_factory.mktemp("video") / "v.mp4"
    images = [_image(height, width, 3 * i) for i in range(4)]
    with VideoWriter(file, fps=fps) as video:
        for rgb in images:
            video.add(rgb)
    frames = list(read_frames(file))
    assert len(frames) == 4
    for frame, rgb in zip(frames, images, strict=True):
        assert frame.shape == (height + height % 2, width + width % 2, 3)
        error = np.abs(frame[:height, :width].astype(int) - rgb)
        assert np.median(error) <= 4, "colours keep their matrix and range"
        assert error.mean() < 12  # edges bleed: colour has half the resolution
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert abs(float(stream.average_rate or Fraction(0)) - fps) < 0.01


def test_same_images_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        with VideoWriter(tmp_path / name) as video:
            video.add(_image(32, 32))
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_an_error_leaves_the_former_file(tmp_path: Path) -> None:
    file = tmp_path / "v.mp4"
    file.write_bytes(b"old")
    with pytest.raises(FileNotFoundError, match="of the caller"):
        _write_until_missing(file)
    with pytest.raises(ValueError, match="one size"):
        _write_sizes(file, [(32, 32), (32, 34)])
    with pytest.raises(DyngsError, match="no images"), VideoWriter(file):
        pass
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_bad_names_and_rates_are_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(DyngsError, match=r"v\.nope.*\.mp4"),
        VideoWriter(tmp_path / "v.nope") as video,
    ):
        video.add(_image(16, 16))
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(DyngsError, match="cannot write"),
        VideoWriter(tmp_path / "file" / "v.mp4") as video,
    ):
        video.add(_image(16, 16))
    with pytest.raises(DyngsError, match="fps"):
        VideoWriter(tmp_path / "v.mp4", fps=0)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_missing_encoder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", set())
    monkeypatch.setattr(OutputContainer, "add_stream", _no_codec, raising=False)
    with pytest.raises(DyngsError, match="libx264"), VideoWriter(tmp_path / "v.mp4") as video:
        video.add(_image(16, 16))
    assert not list(tmp_path.iterdir())


def test_unreadable_videos_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no such video"):
        list(read_frames(tmp_path / "none.mp4"))
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(DyngsError, match=r"text\.mp4"):
        list(read_frames(tmp_path / "text.mp4"))


def _write_sizes(file: Path, sizes: list[tuple[int, int]]) -> None:
    with VideoWriter(file) as video:
        for height, width in sizes:
            video.add(_image(height, width))


def _write_until_missing(file: Path) -> None:
    with VideoWriter(file) as video:
        video.add(_image(32, 32))
        raise FileNotFoundError("of the caller")


def _no_codec(*_: object, **__: object) -> None:
    raise ValueError("unknown codec")
