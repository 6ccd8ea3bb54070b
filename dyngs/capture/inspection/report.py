"""Reports on captures and on videos without poses, with the next command."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from dyngs.capture.inspection.problems import listed, masks_of, problems_of, tallied
from dyngs.capture.sfm.frame_choice import STANDS, displaced_by, measured, shrunk
from dyngs.capture.sfm.several_videos import VIDEOS_FILE, CameraVideo, open_video, read_given
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError, as_word, counted, printable, reading
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.geometry import camera_center, inverse_rigid
from dyngs.data.images.video import opened_video, orientation_of, read_frames, videos_in
from dyngs.data.times import distinct_times
from dyngs.io.containment import inside, leaving_links
from dyngs.io.outputs import Inputs
from dyngs.io.write import write_image

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


# factor between the most and the least light up to which images count as equally exposed
SAME_LIGHT = 1.05


def facts_of(capture: Capture) -> tuple[tuple[str, str], ...]:
    """Return what a capture holds as (name, value) pairs, in the order in which they are shown."""
    views = all_views(capture.splits)
    sizes = Counter(f"{view.width}x{view.height}" for view in views)
    lenses = Counter(view.lens.model for view in views)
    focal_px = [float(f) for view in views for f in (view.intrinsics[0, 0], view.intrinsics[1, 1])]
    fov_deg = [
        float(np.degrees(2 * np.arctan2(0.5 * view.width, view.intrinsics[0, 0]))) for view in views
    ]
    centers = (
        np.array([camera_center(view.cam_from_world) for view in views]).reshape(-1, 3)
        * capture.world_scale
    )
    file = "" if capture.points_file is None else f" ({capture.points_file.name})"
    facts = [
        ("format", capture.format),
        (
            "views",
            ", ".join(f"{len(views)} {split}" for split, views in capture.splits.items() if views),
        ),
        ("sizes", tallied(sizes)),
        ("cameras", str(len({view.camera_id for view in views}))),
        ("focal length", f"{_range(focal_px)} px"),
        ("field of view", f"{_range(fov_deg)} degrees across"),
        ("lens", tallied(lenses)),
        *_exposures(views),
        ("alpha", "transparent background" if capture.has_alpha else "none"),
        ("masks", masks_of(capture)[0] or "none"),
        *_prior_facts(capture),
        *_time_facts(capture),
        ("points", "none" if capture.points is None else f"{len(capture.points.xyz)}{file}"),
    ]
    if len(centers):
        spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
        box = ", ".join(_range(axis) for axis in centers.T)
        facts.append(("camera centres", f"{box}; within {spread:.4g} of their mean"))
    if np.any(capture.world_offset):
        facts.append(
            ("world offset", " ".join(f"{x:.10g}" for x in capture.world_offset) + " (rebased)")
        )
    if capture.body is not None:
        frames = ", ".join(
            f"{len(capture.body[name].frames)} {name}"
            for name in capture.splits
            if name in capture.body
        )
        facts.append(("body", f"{next(iter(capture.body.values())).kind}, frames: {frames}"))
    return tuple(facts)


def _exposures(views: Sequence[View]) -> list[tuple[str, str]]:
    """Return how much the light let in differs by the tags of images; nothing where they do not
    say."""
    known = [view.exposure for view in views if view.exposure is not None]
    if not known:
        return []
    factor = max(known) / min(known)
    light = f"up to {factor:.3g} times as much light; train.exposure=auto finds out if it matters"
    light = "the same" if factor < SAME_LIGHT else light
    return [("exposure", f"by EXIF tags of {len(known)} of {len(views)} images, {light}")]


def _prior_facts(capture: Capture) -> Iterator[tuple[str, str]]:
    """Yield how many views have which priors; nothing where there are none."""
    views = all_views(capture.splits)
    counts = {
        "depth maps": sum(view.depth_path is not None for view in views),
        "motion masks": sum(view.motion_mask_path is not None for view in views),
        "flow fields": sum(view.flow_path is not None for view in views),
        "file of tracks": int(capture.tracks_path is not None),
    }
    found = [f"{count} {what}" for what, count in counts.items() if count]
    if found:
        yield "priors", ", ".join(found)


def _time_facts(capture: Capture) -> Iterator[tuple[str, str]]:
    """Distinct times, cameras by times, the frame rate, and how many frames of videos are
    decoded."""
    views = [view for view in all_views(capture.splits) if view.time is not None]
    if not views:
        yield "times", "none (a static scene)"
        return
    times = set(distinct_times(views).values())
    written = (
        "" if capture.span in (None, (0.0, 1.0)) else f" ({_range(capture.span)} in the files)"
    )
    yield "times", f"{len(times)} in {_range(times)}{written}"
    cameras: defaultdict[int, set[bytes]] = defaultdict(set)
    for view in views:
        cameras[view.camera_id].add(view.cam_from_world.round(9).tobytes())
    moving = sum(len(poses) > 1 for poses in cameras.values())
    motion = "" if not moving else " (moving)" if moving == len(cameras) else f" ({moving} moving)"
    yield (
        "sequence",
        f"{counted(len(cameras), 'camera')}{motion} x {counted(len(times), 'time')}, {counted(len(views), 'image')}",
    )
    if capture.fps is not None:
        yield "frame rate", f"{capture.fps:.6g} per second"
    if capture.seconds is not None:
        yield "duration", f"{capture.seconds:.4g} seconds from time 0 to time 1"
    frames = [view.image_path for view in views if view.video is not None]
    if frames:
        yield (
            "video frames",
            f"{sum(path.is_file() for path in frames)} of {len(frames)} are decoded already",
        )


def _range(values: Iterable[float]) -> str:
    """Return "lowest to highest", or one number where both are about the same."""
    listed = list(values)
    if not listed:
        return "none"
    low = min(listed)
    high = max(listed)
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"


@dataclass(frozen=True)
class InspectReport:
    """Facts of a capture, (name, value) pairs in order, and all that is suspicious; no ``capture``
    if unreadable."""

    root: Path
    capture: Capture | None
    facts: tuple[tuple[str, str], ...]
    problems: tuple[str, ...]


def inspect_capture(source: Path | DataConfig, deep: bool = False) -> InspectReport:
    """Return a report on the capture at ``source``; what makes a capture unreadable is a problem in
    it, no error.

    ``deep``: every image is decoded in full and videos to files, which is slow and finds truncated
    files; otherwise only headers are read, and frames of videos only where they are decoded
    already.
    """
    from dyngs.data.read import read_capture

    options = source if isinstance(source, DataConfig) else DataConfig(root=source)
    links = [
        f"{path}: a link that leads out of the capture, to {place}"
        for path, place in leaving_links(options.root)
    ]
    try:
        capture = read_capture(options, decode_videos=deep)
        with reading(options.root, "`dyngs --debug` shows where"):
            report = report_on(capture, deep)
    except DyngsError as error:
        return InspectReport(options.root, None, (), (str(error), *listed(links)))
    return replace(report, problems=(*listed(links), *report.problems))


def report_on(capture: Capture, deep: bool = False) -> InspectReport:
    """Return the report on a capture that has been read; see ``inspect_capture``."""
    problems = dict.fromkeys([*capture.warnings, *problems_of(capture, deep)])
    return InspectReport(capture.root, capture, facts_of(capture), tuple(problems))


def format_report(report: InspectReport) -> str:
    """Return the report as plain text of several lines."""
    width = max((len(name) for name, _ in report.facts), default=0)
    lines = [f"capture {report.root}"]
    lines += [f"  {name:<{width}}  {value}" for name, value in report.facts]
    if not report.problems:
        lines.append("nothing suspicious")
    else:
        lines.append(f"suspicious ({len(report.problems)}):")
        lines += [f"  - {printable(problem)}" for problem in report.problems]
    return "\n".join(lines)


BACKGROUND = (24, 26, 30)
SPLIT_COLORS = {
    "train": (255, 170, 60),
    "val": (120, 230, 120),
    "test": (80, 190, 255),
    "pose": (80, 190, 255),
}


def draw_cameras(capture: Capture, out: Path, size: int = 640) -> None:
    """Write an image of 2 ``size`` x ``size`` pixels: the scene from above and from the side,
    orthographic.

    Frusta of training cameras are orange, of validation green, of test and new poses blue; points
    have their colours. Up is the mean of the cameras' up axes. Points far beyond the cameras are
    left out.
    """
    from PIL import Image, ImageDraw, ImageFont

    Inputs((capture.root,)).require_output(out)
    views = [(split, view) for split, views in capture.splits.items() for view in views]
    poses = np.stack([inverse_rigid(view.cam_from_world) for _, view in views])
    axes = _drawing_axes(poses)
    xyz, rgb = _near_points(capture, poses[:, :3, 3])
    core = np.quantile(xyz @ axes.T, [0.03, 0.97], axis=0) if len(xyz) else xyz
    reach = np.concatenate([poses[:, :3, 3] @ axes.T, core])
    low = reach.min(axis=0)
    high = reach.max(axis=0)
    extent = max(float((high - low).max()) * 1.2, 1e-6)
    depth = extent * min(0.08, 0.4 / len(poses) ** 0.5)
    panels = []
    for title, shown in (("from above", [0, 1]), ("from the side", [0, 2])):
        image = Image.new("RGB", (2 * size, 2 * size), BACKGROUND)  # at twice its size
        draw = ImageDraw.Draw(image)
        middle = 0.5 * (low + high)[shown]

        def places(points: np.ndarray, at: list[int] = shown, middle: np.ndarray = middle) -> list:
            """Return columns and rows of world points (P, 3); they may lie outside the panel."""
            flat = np.clip((points @ axes[at].T - middle) / extent + 0.5, -10.0, 10.0)
            return ((flat * (1, -1) + (0, 1)) * (2 * size - 1)).tolist()

        for (x, y), colour in zip(places(xyz), np.maximum(rgb, 60).tolist(), strict=True):
            draw.rectangle((x, y, x + 1, y + 1), fill=tuple(colour))
        for (split, view), pose in zip(views, poses, strict=True):
            corners = np.array(
                [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]]
            )
            rays = np.c_[corners, np.ones(4)] @ np.linalg.inv(view.intrinsics).T
            rays *= depth / np.linalg.norm(rays, axis=1, keepdims=True)
            frustum = np.concatenate([np.zeros((1, 3)), rays]) @ pose[:3, :3].T + pose[:3, 3]
            tips = [tuple(place) for place in places(frustum)]
            line = [tips[i] for i in (0, 1, 2, 3, 4, 1, 2, 0, 3, 4, 0)]
            draw.line(line, fill=SPLIT_COLORS[split], width=2)
        draw.text((16, 12), title, fill=(204, 204, 204), font=ImageFont.load_default(28))
        panels.append(np.asarray(image.resize((size, size))))
    write_image(out, np.concatenate(panels, axis=1))


def _drawing_axes(poses: np.ndarray) -> np.ndarray:
    """Return (3, 3) rows right, back and up of the drawing: up is the cameras' mean up."""
    up = -poses[:, :3, 1].mean(axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    lead = np.eye(3)[np.abs(up).argmin()]
    right = np.cross(lead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _near_points(capture: Capture, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Up to about 20,000 points (P, 3) and colours: those within four camera spreads, or the nearer
    half."""
    if capture.points is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    xyz = capture.points.xyz
    rgb = capture.points.rgb
    middle = centers.mean(axis=0)
    distance = np.linalg.norm(xyz - middle, axis=1)
    spread = np.linalg.norm(centers - middle, axis=1).max()
    limit = max(4.0 * spread, float(np.median(distance)))
    near = np.flatnonzero(distance <= limit)
    near = near[:: max(len(near) // 20_000, 1)]
    return xyz[near], rgb[near]
