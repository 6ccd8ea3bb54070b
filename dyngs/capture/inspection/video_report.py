"""Report on videos without poses: what one wants to know before structure from motion, and the next
command."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from dyngs.capture.sfm.frame_choice import STANDS, displaced_by, measured, shrunk
from dyngs.capture.sfm.several_videos import VIDEOS_FILE, CameraVideo, open_video, read_given
from dyngs.core.errors import as_word, counted, reading
from dyngs.data.images.video import opened_video, orientation_of, read_frames, videos_in
from dyngs.io.containment import inside

MAX_FRAMES = 3000  # frames that are looked at, from the first one on
UNEVEN = 1.5  # longest over typical gap between frames of a rate that varies
BLURRED = 0.4  # frames with less than this fraction of the typical sharpness are blurred
# fraction of the width by which the image moves from frame to frame of a camera that moves fast
FAST = 0.02
# fraction of the width by which the image of a camera that hardly moves is displaced over the clip
LITTLE = 0.05

_ORIENTATIONS = (
    "", " (mirrored)", " (rotated by 180 degrees)", " (mirrored upside down)", " (mirrored and rotated by 270 degrees)",
    " (rotated by 90 degrees)", " (mirrored and rotated by 90 degrees)", " (rotated by 270 degrees)",
)  # fmt: skip
"""What is done to frames on reading, by their orientation."""


def video_report(path: Path) -> str:
    """Return a report on a video file, or on the videos of a folder, as lines of text; their frames
    are decoded once."""
    videos = [
        open_video(inside(video)) for video in ([path] if path.is_file() else videos_in(path))
    ]
    lines = []
    moving = []
    for video in videos:
        facts, stands = video_facts(video)
        moving += [] if stands else [video.name]
        width = max(map(len, facts))
        lines.append(f"video {video.path}")
        lines += [f"  {name:<{width}}  {value}" for name, value in facts.items()]
    if len(videos) == 1:
        return "\n".join([*lines, *_next(videos[0].path, bool(moving))])
    if moving:
        names = ", ".join(moving[:5])
        lines.append(f"next: take {names} out: of several videos, only fixed cameras get poses")
        return "\n".join(lines)
    is_given = read_given(path, [video.name for video in videos])[0] is not None
    known = f"as {VIDEOS_FILE} says" if is_given else "found by sound"
    rates = sorted({round(video.rate, 2) for video in videos})
    lines.append(
        f"{len(videos)} fixed cameras, {' and '.join(f'{rate:g}' for rate in rates)} frames per second; "
        f"offsets between them: {known}"
    )
    lines.append(f"next: dyngs train dynamic data.root={as_word(path)}")
    return "\n".join(lines)


def video_facts(video: CameraVideo) -> tuple[dict[str, str], bool]:
    """Return facts about a video for people, by name, and whether its camera is fixed."""
    small: list[np.ndarray] = []

    def frames() -> Iterator[np.ndarray]:
        for rgb in islice(read_frames(video.path), min(MAX_FRAMES, len(video.seconds))):
            small.append(shrunk(rgb))
            yield rgb

    measures = measured(frames())
    displaced = displaced_by(np.stack(small))
    with (
        reading(video.path, "it must be a video; copy or convert it again"),
        opened_video(video.path) as container,
    ):
        first = next(container.decode(container.streams.video[0]))
        turned = _ORIENTATIONS[orientation_of(first) - 1]
        audio = container.streams.audio
        sound = f"{audio[0].codec_context.name}, {audio[0].rate} Hz" if audio else "none"
    gaps = 1000 * np.diff(video.seconds)
    rate = f"{video.rate:.4g} per second"
    if len(gaps) and gaps.max() > UNEVEN * np.median(gaps):
        rate = f"variable rate: {gaps.min():.0f} to {gaps.max():.0f} ms between frames (times are kept)"
    blurred = int((measures.sharpness < BLURRED * np.median(measures.sharpness)).sum())
    speed = float(np.median(measures.motion))
    camera = f"moves by up to {displaced:.1%} of its width, {speed:.2%} from frame to frame"
    if displaced <= STANDS:
        camera = "stands still"
    elif displaced < LITTLE:
        camera += "; hardly at all, which shows little depth"
    elif speed > FAST:
        camera += "; fast: film slower, or at more frames per second"
    facts = {
        "size": f"{video.info.width}x{video.info.height}{turned}",
        "frames": f"{len(video.seconds)} in {video.seconds[-1] + 1 / video.rate:.2f} s, {rate}",
        "colours": video.info.colours,
        "sound": sound,
        "sharpness": counted(blurred, "blurred frame") if blurred else "no blurred frames",
        "camera": camera,
    }
    return {name: value for name, value in facts.items() if value}, displaced <= STANDS


def _next(path: Path, moves: bool) -> list[str]:
    where = as_word(path)
    if not moves:
        return [
            "next: one fixed camera shows no depth; put videos of two or more that ran at once into a folder"
        ]
    return [
        f"next: dyngs train static data.root={where}     # nothing but the camera moves",
        f"      dyngs train dynamic data.root={where}    # something else moves, too",
    ]
