"""Decoding of videos: the frames asked for, and where a damaged file breaks."""

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
from dyngs.data.images import video as video_module
from dyngs.data.images.video import (
    VideoInfo,
    colour_notes,
    probe_video,
    read_frames,
    read_numbered_frames,
)
from dyngs.io.containment import images_up_to


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


def test_a_frame_behind_the_end(video: Path) -> None:
    frames = read_numbered_frames(video, [8, 9])
    assert next(frames)[0] == 8
    with pytest.raises(DyngsError, match=r"cam00\.mp4 breaks at frame 9 "):
        next(frames)


def test_truncated_video(video: Path) -> None:
    """The frames before the break can be had; the error says where it is."""
    short = copy(video, "short.mp4")
    truncate_video(short, 6)
    assert probe_video(short).num_frames == 9
    assert [number for number, _ in read_numbered_frames(short, [0, 1])] == [0, 1]
    with pytest.raises(DyngsError, match=r"short\.mp4 breaks at frame [3-7] .*data\.frames"):
        list(read_numbered_frames(short, range(9)))


def test_video_damaged_in_the_middle(video: Path) -> None:
    broken = copy(video, "broken.mp4")
    data = bytearray(broken.read_bytes())
    for place, size in packet_places(video)[4:6]:
        data[place : place + size] = b"\xa5" * size
    broken.write_bytes(data)
    assert [number for number, _ in read_numbered_frames(broken, [0])] == [0]
    with pytest.raises(DyngsError, match=r"broken\.mp4 breaks at frame [1-6]"):
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


def test_a_title_in_latin_1(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "Café"
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 16, 12, "yuv420p"
        for _ in range(3):
            container.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(np.zeros((12, 16, 3), np.uint8), format="rgb24")
                )
            )
        container.mux(stream.encode(None))
    path.write_bytes(path.read_bytes().replace("Café".encode(), b"Caf\xe9 "))
    assert b"Caf\xe9 " in path.read_bytes()
    assert probe_video(path).num_frames == 3
    assert len(list(read_frames(path))) == 3


@pytest.mark.parametrize(
    "content",
    ["ffconcat version 1.0\nfile cam00.mp4\n", "#EXTM3U\n#EXTINF:1,\n{video}\n#EXT-X-ENDLIST\n"],
)
def test_playlists_which_name_other_files_are_no_videos(video: Path, content: str) -> None:
    path = video.with_name("list.mp4")
    path.write_text(content.format(video=video))
    with pytest.raises(DyngsError, match=r"cannot read the video .*list\.mp4"):
        probe_video(path)


def test_large_videos_are_refused_before_they_are_decoded(
    video: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        images_up_to(0.0005),
        pytest.raises(DyngsError, match=r"32x24 .*data\.max_megapixels is 0\.0005"),
    ):
        probe_video(video)
    monkeypatch.setattr(video_module, "MAX_FRAMES", 8)
    with pytest.raises(
        DyngsError,
        match=r"cam00\.mp4: the video has 9 frames, of which 8 are read at most; cut it up",
    ):
        probe_video(video)


def test_mutated_videos_are_read_or_refused_in_one_line(video: Path) -> None:
    data = video.read_bytes()
    path = video.with_name("mutated.mp4")
    lines = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        changed = bytearray(data)
        for _ in range(rng.choice([1, 4, 16])):
            changed[int(rng.integers(rng.choice([200, 1000, len(data)])))] = rng.integers(256)
        path.write_bytes(changed)
        try:
            for _ in read_numbered_frames(path, range(min(probe_video(path).num_frames, 20))):
                pass
        except DyngsError as error:
            lines.append(str(error))
    assert all(line.isprintable() for line in lines)


MATRICES = {1: (1, 0, 0, 1), 2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1)}
MATRICES |= {5: (0, 1, 1, 0), 6: (0, 1, -1, 0), 7: (0, -1, -1, 0), 8: (0, -1, 1, 0)}
"""Display matrices (a, b, c, d) by the orientation of EXIF that they mean."""


def _display_matrix(a: int, b: int, c: int, d: int) -> bytes:
    return struct.pack(">9i", *(65536 * x for x in (a, b, 0, c, d, 0, 0, 0)), 1 << 30)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_display_matrices_rotate_and_mirror(tmp_path: Path, orientation: int) -> None:
    """As each pixel (x, y) is shown at (a x + c y, b x + d y), moved into the image."""
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


def test_hdr_in_8_bits_without_primaries_and_matrix(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    rgb = patches()
    write_clip(path, encoded(rgb, BT2020, HLG), (UNSPECIFIED, HLG, UNSPECIFIED), bits=8)
    assert levels_off(path, rgb) < 3


def test_brighter_than_white_is_clipped(tmp_path: Path) -> None:
    """Black, diffuse white, the brightest signal of HLG."""
    path = tmp_path / "a.mp4"
    signal = np.zeros((48, 64, 3))
    signal[:, 32:48] = 0.75
    signal[:, 48:] = 1.0
    write_clip(path, signal, (BT2020, HLG, BT2020))
    (frame, _) = read_frames(path)
    assert frame[:, :30].max() <= 1
    assert frame[:, 34:].min() >= 254


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
    note = "HD without colour tags is read as BT.709" if matrix == BT709 else ""
    assert probe_video(path).colours == note


def test_tagged_hd_follows_its_tags(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    rgb = np.full((720, 64, 3), (0.2, 0.7, 0.3))
    write_clip(path, rgb, (UNSPECIFIED, UNSPECIFIED, BT601), matrix=BT601, bits=8)
    assert levels_off(path, rgb) < 2.5
    assert probe_video(path).colours == ""


def test_a_matrix_that_cannot_be_converted_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    ictcp = 14
    write_clip(path, patches(), (BT2020, PQ, ictcp))
    with pytest.raises(
        DyngsError, match=r"a\.mp4: its colours have the matrix 14 .* export .*HDR10"
    ):
        probe_video(path)


def test_colour_notes_count_the_videos_of_each_kind() -> None:
    videos = [VideoInfo(4, 4, 1, 30.0, colours) for colours in ("PQ", "", "HLG", "PQ", "PQ")]
    assert colour_notes(videos) == ["3 videos: PQ", "1 video: HLG"]
