"""Report on videos without poses: what one wants to know before structure from motion, and the next
command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from dyngs.capture.multi_video.films import (
    STANDS,
    VIDEOS_FILE,
    Film,
    displaced_by,
    displacement,
    open_film,
    read_given,
    shrunk_grey,
)
from dyngs.core.errors import as_word, counted, reading
from dyngs.data.images.video import opened_video, orientation_of, read_frames, videos_in
from dyngs.data.times import evenly_spaced
from dyngs.io.containment import inside

MAX_FRAMES = 3000  # frames that are looked at, from the first one on
UNEVEN = 1.5  # longest over typical gap between frames of a rate that varies
BLURRED = 0.5  # frames with less than this fraction of the typical sharpness are blurred
# fraction of the width by which the image moves from frame to frame of a camera that moves fast
FAST = 0.05
# fraction of the width by which the image of a camera that hardly moves is displaced over the clip
LITTLE = 0.05
_PAIRS = 40


@dataclass(frozen=True)
class VideoFacts:
    """Facts about a video, (name, value) pairs for people, in order, and whether its camera stands
    still."""

    film: Film
    facts: tuple[tuple[str, str], ...]
    stands: bool


def video_report(path: Path) -> str:
    """Return a report on a video file, or on the videos of a folder, as lines of text."""
    if path.is_file():
        found = video_facts(path)
        return "\n".join([*_lines(found), *_next(path, found)])
    videos = videos_in(path)
    if len(videos) == 1:
        return video_report(videos[0])
    reports = [video_facts(video) for video in videos]
    lines = [line for found in reports for line in _lines(found)]
    return "\n".join([*lines, *_next_of_folder(path, reports)])


def video_facts(path: Path) -> VideoFacts:
    """Return what there is to know about a video; its frames are decoded once."""
    film = open_film(inside(path))
    small, sharpness = _look(film)
    displaced = displaced_by(small)
    shown, sound = _streams(path)
    seconds = film.seconds
    facts = (
        ("size", f"{film.info.width}x{film.info.height}" + shown),
        ("frames", f"{len(seconds)} in {seconds[-1] + 1 / film.rate:.2f} s, {_rate(film)}"),
        *([("colours", film.info.colours)] if film.info.colours else []),
        ("sound", sound),
        ("sharpness", _sharpness(sharpness)),
        ("camera", _camera(small, displaced)),
    )
    return VideoFacts(film, facts, displaced <= STANDS)


def _look(film: Film) -> tuple[np.ndarray, np.ndarray]:
    small = []
    sharpness = []
    for rgb in islice(read_frames(film.path), min(MAX_FRAMES, len(film.seconds))):
        small.append(shrunk_grey(rgb))
        step = max(max(rgb.shape[:2]) // 800, 1)
        grey = rgb[::step, ::step, 1].astype(np.float32)
        sharpness.append(
            float(np.diff(grey, axis=0).std() + np.diff(grey, axis=1).std())
            if min(grey.shape) > 1
            else 0.0
        )
    return np.stack(small), np.array(sharpness)


_ORIENTATIONS = (
    "", "mirrored", "rotated by 180 degrees", "mirrored upside down", "mirrored and rotated by 270 degrees",
    "rotated by 90 degrees", "mirrored and rotated by 90 degrees", "rotated by 270 degrees",
)  # fmt: skip
"""What is done to frames on reading, by their orientation."""


def _streams(path: Path) -> tuple[str, str]:
    """Return what is done to frames on reading, in brackets, and what sound there is."""
    with (
        reading(path, "it must be a video; copy or convert it again"),
        opened_video(path) as container,
    ):
        first = next(container.decode(container.streams.video[0]))
        done = _ORIENTATIONS[orientation_of(first) - 1]
        audio = container.streams.audio
        return (
            f" ({done})" if done else "",
            f"{audio[0].codec_context.name}, {audio[0].rate} Hz" if audio else "none",
        )


def _rate(film: Film) -> str:
    gaps = np.diff(film.seconds)
    if len(gaps) and gaps.max() > UNEVEN * np.median(gaps):
        return f"variable rate: {1000 * gaps.min():.0f} to {1000 * gaps.max():.0f} ms between frames (times are kept)"
    return f"{film.rate:.4g} per second"


def _sharpness(sharpness: np.ndarray) -> str:
    typical = float(np.median(sharpness))
    blurred = int((sharpness < BLURRED * typical).sum())
    low = sharpness.min() / max(typical, 1e-9)
    high = sharpness.max() / max(typical, 1e-9)
    found = counted(blurred, "blurred frame") if blurred else "no blurred frames"
    return f"{low:.2f} to {high:.2f} of the typical frame; {found}"


def _camera(small: np.ndarray, displaced: float) -> str:
    if displaced <= STANDS:
        return "stands still"
    starts = evenly_spaced(len(small) - 1, _PAIRS)
    steps = [displacement(small[i].astype(float), small[i + 1].astype(float)) for i in starts]
    known = [step for step in steps if np.isfinite(step)]
    far = "far" if np.isinf(displaced) else f"by up to {displaced:.1%} of its width"
    if not known:
        return f"moves {far}; too fast or too blurred to follow from frame to frame"
    median = float(np.median(known))
    fast = "; fast: film slower, or at more frames per second" if median > FAST else ""
    fast = "; hardly at all, which shows little depth" if displaced < LITTLE else fast
    return f"moves {far}, {median:.2%} of its width from frame to frame{fast}"


def _lines(found: VideoFacts) -> list[str]:
    width = max(len(name) for name, _ in found.facts)
    return [
        f"video {found.film.path}",
        *(f"  {name:<{width}}  {value}" for name, value in found.facts),
    ]


def _next(path: Path, found: VideoFacts) -> list[str]:
    where = as_word(path)
    if found.stands:
        return [
            "next: one fixed camera shows no depth; put videos of two or more that ran at once into a folder"
        ]
    return [
        f"next: dyngs train static data.root={where}     # nothing but the camera moves",
        f"      dyngs train dynamic data.root={where}    # something else moves, too",
    ]


def _next_of_folder(folder: Path, reports: Sequence[VideoFacts]) -> list[str]:
    moving = [found.film.name for found in reports if not found.stands]
    if moving:
        return [
            f"next: take {', '.join(moving[:5])} out: of several videos, only fixed cameras get poses"
        ]
    names = [found.film.name for found in reports]
    rates = {round(found.film.rate, 2) for found in reports}
    known = (
        "found by sound or motion"
        if read_given(folder, names)[0] is None
        else f"as {VIDEOS_FILE} says"
    )
    return [
        f"{len(names)} fixed cameras, {' and '.join(f'{rate:g}' for rate in sorted(rates))} frames per second; "
        f"offsets between them: {known}",
        f"next: dyngs train dynamic data.root={as_word(folder)}",
    ]
