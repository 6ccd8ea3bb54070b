"""Decoding of videos: requested frames, orientation, colours and damaged files."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import av
import numpy as np
import pytest
from hdr_clips import (
    BT601,
    BT709,
    BT2020,
    DISPLAY_P3,
    HLG,
    PQ,
    UNSPECIFIED,
    add_colour_box,
    encoded,
    patches,
    write_clip,
)
from tiny_captures import level_of, packet_places, truncate_video, write_video

from dyngs.core.errors import DyngsError
from dyngs.data.images.video import (
    VideoInfo,
    probe_video,
    read_frames,
    read_numbered_frames,
)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "cam00.mp4"
    write_video(path, 9, fps=25, size=(32, 24))
    return path


def copy(video: Path, name: str) -> Path:
    return Path(shutil.copy(video, video.with_name(name)))


def test_video_probe(video: Path) -> None:
    assert probe_video(video) == VideoInfo(32, 24, 9, 25.0)


@pytest.mark.parametrize("numbers", [[0], [8], [1, 2, 7], [7, 1, 2], range(9), []])
def test_wanted_frames_in_order(video: Path, numbers: list[int]) -> None:
    found = list(read_numbered_frames(video, numbers))
    assert [number for number, _ in found] == sorted(numbers)
    everything = list(read_frames(video))
    assert len(everything) == 9
    for number, rgb in found:
        assert rgb.shape == (24, 32, 3)
        assert np.abs(rgb.astype(int) - level_of(number)).max() <= 6, (
            "colours are converted in 8 bit"
        )
        np.testing.assert_array_equal(rgb, everything[number])


def test_video_damaged_in_the_middle(video: Path) -> None:
    broken = copy(video, "broken.mp4")
    data = bytearray(broken.read_bytes())
    for place, size in packet_places(video)[4:6]:
        data[place : place + size] = b"\xa5" * size
    broken.write_bytes(data)
    assert [number for number, _ in read_numbered_frames(broken, [0])] == [0]
    with pytest.raises(DyngsError, match=r"broken\.mp4 at frame [1-6]"):
        list(read_numbered_frames(broken, range(9)))


def test_no_video_at_all(video: Path) -> None:
    with pytest.raises(DyngsError, match="no such video file"):
        probe_video(video.with_name("none.mp4"))
    text = video.with_name("text.mp4")
    text.write_text("not a video " * 50)
    with pytest.raises(DyngsError, match=r"cannot read the video .*text\.mp4"):
        probe_video(text)
    empty = copy(video, "empty.mp4")
    truncate_video(empty, 0)
    with pytest.raises(DyngsError, match=r"empty\.mp4"):
        probe_video(empty)


@pytest.mark.parametrize(
    "content",
    ["ffconcat version 1.0\nfile cam00.mp4\n", "#EXTM3U\n#EXTINF:1,\n{video}\n#EXT-X-ENDLIST\n"],
)
def test_playlists_which_name_other_files_are_no_videos(video: Path, content: str) -> None:
    path = video.with_name("list.mp4")
    path.write_text(content.format(video=video))
    with pytest.raises(DyngsError, match=r"cannot read the video .*list\.mp4"):
        probe_video(path)


MATRICES = {1: (1, 0, 0, 1), 2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1)}
MATRICES |= {5: (0, 1, 1, 0), 6: (0, 1, -1, 0), 7: (0, -1, -1, 0), 8: (0, -1, 1, 0)}
"""Display matrices (a, b, c, d) by the orientation of EXIF that they mean."""


def _display_matrix(a: int, b: int, c: int, d: int) -> bytes:
    return struct.pack(">9i", *(65536 * x for x in (a, b, 0, c, d, 0, 0, 0)), 1 << 30)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_display_matrices_rotate_and_mirror(tmp_path: Path, orientation: int) -> None:
    """The matrix shows pixel (x, y) at (a x + c y, b x + d y), shifted into the image."""
    path = tmp_path / "a.mp4"
    stored = np.kron(np.array([[20, 80], [140, 220]], np.uint8), np.ones((16, 24), np.uint8))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        container.mux(
            stream.encode(av.VideoFrame.from_ndarray(np.dstack([stored] * 3), format="rgb24"))
        )
        container.mux(stream.encode(None))
    data = path.read_bytes()
    upright = _display_matrix(1, 0, 0, 1)
    place = data.index(upright, data.index(b"tkhd"))
    a, b, c, d = MATRICES[orientation]
    path.write_bytes(data[:place] + _display_matrix(a, b, c, d) + data[place + len(upright) :])
    rows, columns = np.mgrid[:32, :48]
    x = a * columns + c * rows
    y = b * columns + d * rows
    shown = np.zeros((np.ptp(y) + 1, np.ptp(x) + 1), np.uint8)
    shown[y - y.min(), x - x.min()] = stored
    (frame,) = read_frames(path)
    assert frame.shape[:2] == shown.shape
    assert np.abs(frame[..., 1].astype(int) - shown).max() < 30, (
        "but for the edges of a compressed image"
    )
    assert (probe_video(path).width, probe_video(path).height) == shown.shape[::-1]


def levels_off(path: Path, rgb: np.ndarray) -> float:
    """Root of the mean squared difference of the frames of a clip from an sRGB image in [0, 1], in
    levels."""
    frames = [*read_frames(path), *(frame for _, frame in read_numbered_frames(path, [1]))]
    assert len(frames) == 3
    return max(float(np.sqrt(np.mean((frame - 255 * rgb) ** 2))) for frame in frames)


@pytest.mark.parametrize("is_full_range", [False, True])
@pytest.mark.parametrize(
    ("primaries", "transfer", "matrix"),
    [
        (BT2020, HLG, BT2020),
        (BT2020, HLG, BT709),
        (BT2020, HLG, BT601),
        (BT709, HLG, BT709),
        (BT2020, PQ, BT2020),
        (DISPLAY_P3, PQ, BT601),
        (BT2020, BT709, BT2020),
        (DISPLAY_P3, BT709, BT709),
        (BT709, BT709, BT2020),
    ],
)
def test_colours_come_back(
    tmp_path: Path, primaries: int, transfer: int, matrix: int, is_full_range: bool
) -> None:
    path = tmp_path / "a.mp4"
    rgb = patches()
    signal = encoded(rgb, primaries, transfer)
    tags = (primaries, transfer, matrix)
    write_clip(path, signal, tags, matrix=matrix, is_full_range=is_full_range)
    assert levels_off(path, rgb) < 2.5
    kinds = {HLG: "HLG is tone-mapped", PQ: "PQ is tone-mapped"}
    sdr = {BT2020: "from BT.2020 to BT.709", DISPLAY_P3: "from Display P3 to BT.709", BT709: ""}[
        primaries
    ]
    assert kinds.get(transfer, sdr) in probe_video(path).colours


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("is_full_range", [False, True])
def test_tags_of_the_container_alone(tmp_path: Path, codec: str, is_full_range: bool) -> None:
    """FFmpeg's decoder of HEVC overwrites them by "unspecified"."""
    path = tmp_path / "a.mp4"
    rgb = patches()
    untagged = (UNSPECIFIED, UNSPECIFIED, UNSPECIFIED)
    signal = encoded(rgb, BT2020, HLG)
    write_clip(path, signal, untagged, codec=codec, is_full_range=is_full_range)
    assert "HLG" not in probe_video(path).colours
    add_colour_box(path, BT2020, HLG, BT2020, is_full_range)
    assert levels_off(path, rgb) < 2.5
    assert "HLG is tone-mapped" in probe_video(path).colours


@pytest.mark.parametrize(
    ("size", "matrix"), [((576, 64), BT601), ((720, 64), BT709), ((64, 1280), BT709)]
)
@pytest.mark.parametrize("bits", [8, 10])
def test_untagged_video_is_bt601_in_sd_and_bt709_in_hd(
    tmp_path: Path, size: tuple[int, int], matrix: int, bits: int
) -> None:
    path = tmp_path / "a.mp4"
    rgb = np.full((*size, 3), (0.2, 0.7, 0.3))
    write_clip(path, rgb, (UNSPECIFIED, UNSPECIFIED, UNSPECIFIED), matrix=matrix, bits=bits)
    assert levels_off(path, rgb) < 2.5
    note = "HD without colour tags, assumed to be BT.709" if matrix == BT709 else ""
    assert probe_video(path).colours == note
