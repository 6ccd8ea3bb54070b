"""Inspection of captures and videos: their contents, likely problems, and the next command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from dyngs.capture.sfm.frame_choice import (
    FIXED_CAMERA_LIMIT,
    camera_displacement,
    measure_frames,
    small_brightness,
)
from dyngs.capture.sfm.several_videos import (
    VIDEOS_FILE,
    CameraVideo,
    open_video,
    read_video_settings,
)
from dyngs.config import DataConfig
from dyngs.core.errors import (
    DyngsError,
    format_count,
    format_one_line,
    quote_path,
    wrap_read_errors,
)
from dyngs.data.body_frames import merge_root_rotation
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.geometry import (
    camera_center,
    count_visible_views,
    focus_point,
    fraction_in_front,
    invert_rigid,
    perpendicular,
    unit,
)
from dyngs.data.images.images import read_header, read_image, read_mask, try_read_header
from dyngs.data.images.video import list_videos, open_video_container, read_frames
from dyngs.data.times import distinct_times, evenly_spaced
from dyngs.io.containment import check_inside, find_escaping_links
from dyngs.io.outputs import Inputs
from dyngs.io.write import write_image

# Problems of captures, one line each

MAX_LINES_PER_KIND = 5  # problems of one kind that are listed; the others are counted
MAX_VIEWS = 300  # views, evenly spaced, in which points are looked for
# degrees between neighbouring views, seen from the scene, from which they are far apart
WIDE_BASELINE = 10.0
CLOSE_IN_TIME, FEW_VIEWS = 0.08, 3
"""Fraction of a clip with little motion; if fewer views are in it, each time step is seen from one
side."""
# degrees around a body without a camera from which on a part of it is hardly seen
UNSEEN_SIDE = 200.0
LOOKED_AT = 4  # masks that are read
# fraction of the pixels that masks may ignore before that is suspicious: passers-by fill less
MOST_IGNORED = 0.5


def check_before_training(capture: Capture) -> list[str]:
    """Return messages on everything in a capture that may harm training; only some masks are
    read."""
    masks, problems = describe_masks(capture)
    line = [] if masks is None else [f"masks of {masks}"]
    found = [*capture.warnings, *line, *problems, *time_problems(capture), *scene_problems(capture)]
    return list(dict.fromkeys([*found, *body_problems(capture)]))


def time_problems(capture: Capture) -> list[str]:
    """Return problems of times and viewpoints: a moving scene must be seen from several sides.

    Reported are a single fixed camera, and few images at different times from distant viewpoints.
    Many such images (as in D-NeRF) are fine: neighbours in time then show nearly the same.
    """
    views = [view for view in capture.splits.get("train", ()) if view.time is not None]
    views.sort(key=lambda view: view.time or 0.0)
    count = len(set(distinct_times(views).values()))
    if capture.body is not None or count < 2:
        return []
    if len({view.cam_from_world.round(9).tobytes() for view in views}) == 1:
        return [
            f"a single fixed camera recorded all {count} times: a moving scene cannot be "
            "reconstructed from one viewpoint; move the camera or use several"
        ]
    if not 3 <= len(views) == count or count * CLOSE_IN_TIME >= FEW_VIEWS:
        return []
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    center = focus_point(poses) if capture.points is None else np.median(capture.points.xyz, axis=0)
    if center is None:
        return []
    directions = unit(poses[:, :3, 3] - center)
    angles = np.degrees(np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1)))
    if not angles.mean() >= WIDE_BASELINE:
        return []
    return [
        f"{len(views)} images at different times, {angles.mean():.0f} degrees apart on average: "
        "moving objects are seen from one side only at each time; expect a static result"
    ]


def body_problems(capture: Capture) -> list[str]:
    """Return a message if no training view shows one side of a captured person."""
    body = None if capture.body is None else capture.body["train"]
    if body is None:
        return []
    from scipy.spatial.transform import Rotation  # late: importing it takes a tenth of a second

    body = merge_root_rotation(body, np.zeros(3) if body.pelvis is None else body.pelvis)
    rows = {frame: row for row, frame in enumerate(body.frames)}
    seen = [(rows[v.frame], v) for v in capture.splits.get("train", ()) if v.frame in rows]
    if not seen:
        return []
    at = [row for row, _ in seen]
    away = np.stack([camera_center(view.cam_from_world) for _, view in seen]) - body.trans[at]
    away = Rotation.from_rotvec(body.poses[at, 0]).inv().apply(away)
    # 0 in front, 90 on the person's left
    around = np.sort(np.degrees(np.arctan2(away[:, 0], away[:, 2])))
    gaps = np.diff(np.append(around, around[0] + 360))
    widest = int(gaps.argmax())
    if gaps[widest] < UNSEEN_SIDE:
        return []
    middle = round((around[widest] + gaps[widest] / 2) / 90) % 4
    side = ("front", "left side", "back", "right side")[middle]
    return [
        f"the person's {side} is in no image: all cameras are within {360 - gaps[widest]:.0f} "
        "degrees around the body; the unseen side will be guessed (film a full turn, or use "
        "more cameras)"
    ]


def scene_problems(capture: Capture) -> list[str]:
    """Return problems of poses and points: cameras that look away, points that no camera sees."""
    views = all_views(capture.splits)
    problems = []
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    centers = poses[:, :3, 3]
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    is_static = capture.body is None and all(view.time is None for view in views)
    if len(poses) > 1 and spread < 1e-9 and is_static:
        problems.append("all cameras are at the same position, so depth cannot be estimated")
    xyz = capture.points.xyz if capture.points is not None else np.zeros((0, 3))
    focus = np.median(xyz, axis=0) if len(xyz) else focus_point(poses)
    if focus is not None and fraction_in_front(poses, focus) < 0.5:
        problems.append(
            f"{1 - fraction_in_front(poses, focus):.0%} of the cameras look away from the scene; "
            "check the axes of the poses (JSON files use OpenGL camera-to-world)"
        )
    if len(xyz):
        sample = xyz[np.random.default_rng(0).permutation(len(xyz))[:2000]]
        some = [views[index] for index in evenly_spaced(len(views), MAX_VIEWS)]
        unseen = float((count_visible_views(sample, some) == 0).mean())
        if unseen > 0.1:
            problems.append(f"{unseen:.0%} of the points are not visible in any view")
    return problems


def limit_messages(lines: Iterable[str]) -> list[str]:
    """Return at most ``MAX_LINES_PER_KIND`` messages, and a count of the others."""
    found = list(lines)
    more = len(found) - MAX_LINES_PER_KIND
    if more <= 0:
        return found
    return [*found[:MAX_LINES_PER_KIND], f"... and {more} more of this kind"]


def find_problems(capture: Capture, deep: bool) -> list[str]:
    """Return messages on all problems besides the capture's own warnings; ``deep``: decode every
    image."""
    views = all_views(capture.splits)
    train = capture.splits.get("train", ())
    problems = []
    if not capture.splits.get("test"):
        problems.append("no test views, so quality cannot be measured (see data.test_every)")
    if len(train) < 3:
        problems.append(f"only {len(train)} training views; use at least 20")
    poses = Counter(view.cam_from_world.round(9).tobytes() for view in views if view.time is None)
    same = sum(count for count in poses.values() if count > 1)
    if same:
        problems.append(f"{same} views of a static scene have the same pose as another view")
    problems += limit_messages(
        f"'{view.name}': unusual intrinsics for an image of {view.width}x{view.height}: focal lengths "
        f"({view.intrinsics[0, 0]:g}, {view.intrinsics[1, 1]:g}), centre ({view.intrinsics[0, 2]:g}, "
        f"{view.intrinsics[1, 2]:g}) px"
        for view in views
        if not _is_usual_camera(view)
    )
    problems += [*_image_problems(views, deep), *describe_masks(capture)[1]]
    return [*problems, *time_problems(capture), *scene_problems(capture), *body_problems(capture)]


def _is_usual_camera(view: View) -> bool:
    size = np.array([view.width, view.height])
    fx, fy = np.diag(view.intrinsics)[:2]
    is_central = bool((np.abs(view.intrinsics[:2, 2] / size - 0.5) <= 0.2).all())
    return is_central and 0.9 < fx / fy < 1.1 and 0.05 < fx / size.max() < 50


def _image_problems(views: Iterable[View], deep: bool) -> list[str]:
    problems = []
    for view in views:
        for path in (view.image_path, view.mask_path):
            if path is None or (view.video is not None and not path.is_file()):
                continue
            described = (view.width, view.height)
            try:
                header = read_header(path)
                if deep:
                    read_image(path)
            except DyngsError as error:
                problems.append(str(error))
                continue
            if header.size_matching(described) != described:
                problems.append(
                    f"{path} has {header.width}x{header.height} pixels, but its camera is "
                    f"{view.width}x{view.height}"
                )
    return limit_messages(problems)


def describe_masks(capture: Capture) -> tuple[str | None, list[str]]:
    """Return a description of the masks, None without any, and a message if they ignore most
    pixels.

    A few masks are read; unreadable ones are reported elsewhere.
    """
    views = all_views(capture.splits)
    paths = [view.mask_path for view in views if view.mask_path is not None]
    if not paths:
        return None, []
    found = f"{len(paths)} of {len(views)} images (white = used, black = ignored)"
    sample = [paths[index] for index in evenly_spaced(len(paths), LOOKED_AT)]
    try:
        ignored = fmean(1 - float(read_mask(path).float().mean()) for path in sample)
    except DyngsError:
        return found, []
    found += f": {ignored:.0%} of the pixels ignored in {len(sample)} sampled masks"
    if ignored <= MOST_IGNORED:
        return found, []
    return found, [
        f"masks ignore {ignored:.0%} of the pixels in {len(sample)} sampled masks, first "
        f"{sample[0]}; white (255) = used, black = ignored: are they inverted, or label images?"
    ]


# Facts about captures, and reports


@dataclass(frozen=True)
class InspectReport:
    """Facts of a capture as (name, value) pairs, and its problems; ``capture`` is None if
    unreadable."""

    root: Path
    capture: Capture | None
    facts: tuple[tuple[str, str], ...]
    problems: tuple[str, ...]


def inspect_capture(source: Path | DataConfig, deep: bool = False) -> InspectReport:
    """Return a report on the capture at ``source``; errors of reading become problems of the
    report.

    ``deep``: decode all images and videos, which is slow but finds truncated files; otherwise only
    headers and cached video frames are read.
    """
    from dyngs.data.read import read_capture

    options = source if isinstance(source, DataConfig) else DataConfig(root=source)
    links = limit_messages(
        f"{path}: link to {place}, outside the capture"
        for path, place in find_escaping_links(options.root)
    )
    try:
        capture = read_capture(options, decode_videos=deep)
        with wrap_read_errors(options.root, "see `dyngs --debug`"):
            report = build_report(capture, deep)
    except DyngsError as error:
        return InspectReport(options.root, None, (), (str(error), *links))
    return replace(report, problems=(*links, *report.problems))


def inspect_photos(options: DataConfig) -> InspectReport:
    """Return a report on a folder of photos without poses."""
    from dyngs.capture.sfm.photos import list_photos

    root = options.root
    headers = [
        header
        for path in list_photos(root / "images" if (root / "images").is_dir() else root)
        if (header := try_read_header(path)) is not None
    ]
    focals = [header.focal_px for header in headers if header.focal_px is not None]
    focal = f"{_range(focals)} px, in {len(focals)} photos" if focals else "unknown"
    facts = {
        "photos": f"{len(headers)} without poses",
        "sizes": _tallied("{}x{}".format(*header.upright_size) for header in headers),
        "focal length": f"{focal} (EXIF)",
        "next": f"`dyngs train {quote_path(root)}` estimates the poses, then trains",
    }
    return InspectReport(root, None, tuple(facts.items()), ())


def build_report(capture: Capture, deep: bool = False) -> InspectReport:
    """Return the report on a capture that has been read; see ``inspect_capture``."""
    problems = dict.fromkeys([*capture.warnings, *find_problems(capture, deep)])
    return InspectReport(capture.root, capture, tuple(_facts_of(capture)), tuple(problems))


def format_report(report: InspectReport) -> str:
    """Return the report as plain text of several lines."""
    lines = [f"capture {report.root}", *_aligned(dict(report.facts))]
    if not report.problems:
        lines.append("no problems found")
    else:
        lines.append(f"problems ({len(report.problems)}):")
        lines += [f"  - {format_one_line(problem)}" for problem in report.problems]
    return "\n".join(lines)


def _aligned(facts: dict[str, str]) -> list[str]:
    width = max(map(len, facts), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in facts.items()]


def _facts_of(capture: Capture) -> Iterator[tuple[str, str]]:
    """Yield the facts of a capture as (name, value) pairs in display order."""
    views = all_views(capture.splits)
    split_sizes = [f"{len(views)} {split}" for split, views in capture.splits.items() if views]
    focal_px = np.array([np.diag(view.intrinsics)[:2] for view in views])
    sides = np.array([view.width for view in views])
    fov_deg = np.degrees(2 * np.arctan2(0.5 * sides, focal_px[:, 0]))
    yield "format", capture.format
    yield "views", ", ".join(split_sizes)
    yield "sizes", _tallied(f"{view.width}x{view.height}" for view in views)
    yield "cameras", str(len({view.camera_id for view in views}))
    yield "focal length", f"{_range(focal_px.ravel())} px"
    yield "field of view", f"{_range(fov_deg)} degrees across"
    yield "lens", _tallied(view.lens.model for view in views)
    yield "alpha", "transparent background" if capture.has_alpha else "none"
    yield "masks", describe_masks(capture)[0] or "none"
    priors = {
        "depth maps": sum(view.depth_path is not None for view in views),
        "motion masks": sum(view.motion_mask_path is not None for view in views),
        "flow fields": sum(view.flow_path is not None for view in views),
        "file of tracks": int(capture.tracks_path is not None),
    }
    found = [f"{count} {what}" for what, count in priors.items() if count]
    if found:
        yield "priors", ", ".join(found)
    yield from _time_facts(capture)
    file = "" if capture.points_file is None else f" ({capture.points_file.name})"
    yield "points", "none" if capture.points is None else f"{len(capture.points.xyz)}{file}"
    centers = np.array([camera_center(view.cam_from_world) for view in views])
    centers *= capture.world_scale
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    box = ", ".join(_range(axis) for axis in centers.T)
    yield "camera centres", f"{box}; within {spread:.4g} of their mean"
    if np.any(capture.world_offset):
        yield "world offset", " ".join(f"{x:.10g}" for x in capture.world_offset) + " (rebased)"
    if capture.body is not None:
        frames = [f"{len(body.frames)} {name}" for name, body in capture.body.items()]
        yield "body", f"{capture.body['train'].kind}, frames: {', '.join(frames)}"


def _time_facts(capture: Capture) -> Iterator[tuple[str, str]]:
    """Distinct times, cameras by times, and the frame rate."""
    views = [view for view in all_views(capture.splits) if view.time is not None]
    if not views:
        yield "times", "none (a static scene)"
        return
    times = set(distinct_times(views).values())
    written = (
        ""
        if capture.file_time_span in (None, (0.0, 1.0))
        else f" ({_range(capture.file_time_span)} in the files)"
    )
    yield "times", f"{len(times)} in {_range(times)}{written}"
    cameras = format_count(len({view.camera_id for view in views}), "camera")
    yield (
        "sequence",
        f"{cameras} x {format_count(len(times), 'time')}, {format_count(len(views), 'image')}",
    )
    if capture.fps is not None:
        yield "frame rate", f"{capture.fps:.6g} per second"
    if capture.seconds is not None:
        yield "duration", f"{capture.seconds:.4g} seconds from time 0 to time 1"


def _tallied(keys: Iterable[str]) -> str:
    """Return the most frequent keys with their counts."""
    counter = Counter(keys)
    if len(counter) == 1:
        return next(iter(counter))
    return ", ".join(f"{key} ({count})" for key, count in counter.most_common(6))


def _range(values: Iterable[float]) -> str:
    """Return "lowest to highest", or one number where both are about the same."""
    found = list(values)
    low = min(found)
    high = max(found)
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"


BACKGROUND = (24, 26, 30)
SPLIT_COLORS = {
    "train": (255, 170, 60),
    "val": (120, 230, 120),
    "test": (80, 190, 255),
    "pose": (80, 190, 255),
}


def draw_cameras(capture: Capture, out: Path, size: int = 640) -> None:
    """Write an image of 2 ``size`` x ``size`` pixels: orthographic views from above and from the
    side.

    Camera frusta are orange for training, green for validation, blue for test and pose; points
    have their colours. Up is the mean up axis of the cameras. Points far beyond the cameras are
    omitted.
    """
    from PIL import Image, ImageDraw, ImageFont

    Inputs((capture.root,)).require_output(out)
    views = [(split, view) for split, views in capture.splits.items() for view in views]
    poses = np.stack([invert_rigid(view.cam_from_world) for _, view in views])
    centers = poses[:, :3, 3]
    up = -poses[:, :3, 1].mean(axis=0)
    up = unit(up) if np.linalg.norm(up) > 1e-3 else np.array([0.0, 0.0, 1.0])
    right = perpendicular(up)
    axes = np.stack([right, np.cross(up, right), up])
    xyz = np.zeros((0, 3)) if capture.points is None else capture.points.xyz
    rgb = xyz if capture.points is None else capture.points.rgb
    distance = np.linalg.norm(xyz - centers.mean(axis=0), axis=1)
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    near = np.flatnonzero(distance <= 4.0 * spread)
    near = near[:: max(len(near) // 20_000, 1)]
    core = np.quantile(xyz[near] @ axes.T, [0.03, 0.97], axis=0) if len(near) else xyz[near]
    reach = np.concatenate([centers @ axes.T, core])
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

        for (x, y), colour in zip(
            places(xyz[near]), np.maximum(rgb[near], 60).tolist(), strict=True
        ):
            draw.rectangle((x, y, x + 1, y + 1), fill=tuple(colour))
        for (split, view), pose in zip(views, poses, strict=True):
            corners = np.array(
                [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]]
            )
            rays = np.c_[corners, np.ones(4)] @ np.linalg.inv(view.intrinsics).T
            frustum = np.concatenate([np.zeros((1, 3)), depth * unit(rays)])
            tips = [tuple(place) for place in places(frustum @ pose[:3, :3].T + pose[:3, 3])]
            line = [tips[i] for i in (0, 1, 2, 3, 4, 1, 2, 0, 3, 4, 0)]
            draw.line(line, fill=SPLIT_COLORS[split], width=2)
        draw.text((16, 12), title, fill=(204, 204, 204), font=ImageFont.load_default(28))
        panels.append(np.asarray(image.resize((size, size))))
    write_image(out, np.concatenate(panels, axis=1))


# Videos without poses

MAX_FRAMES = 3000  # frames that are looked at, from the first one on
UNEVEN = 1.5  # longest over typical gap between frames of a rate that varies
BLURRED = 0.4  # frames with less than this fraction of the typical sharpness are blurred


def video_report(path: Path) -> str:
    """Return a text report on a video file, or on the videos of a folder; frames are decoded
    once."""
    videos = [
        open_video(check_inside(video))
        for video in ([path] if path.is_file() else list_videos(path))
    ]
    lines = []
    moving = []
    for video in videos:
        facts, stands = video_facts(video)
        moving += [] if stands else [video.name]
        lines += [f"video {video.path}", *_aligned(facts)]
    where = quote_path(videos[0].path if len(videos) == 1 else path)
    if len(videos) == 1 and moving:
        lines.append(f"next: dyngs train static {where}     # only the camera moves")
        lines.append(f"      dyngs train dynamic {where}    # objects move as well")
    elif len(videos) == 1:
        lines.append(
            "next: one fixed camera gives no depth; put synchronous videos of two or more into a "
            "folder"
        )
    elif moving:
        names = ", ".join(moving[:5])
        lines.append(f"next: remove {names}: several videos are supported only for fixed cameras")
    else:
        is_given = read_video_settings(path, [video.name for video in videos])[0] is not None
        known = f"from {VIDEOS_FILE}" if is_given else "estimated from sound"
        lines.append(f"{len(videos)} fixed cameras; offsets between them: {known}")
        lines.append(f"next: dyngs train dynamic {where}")
    return "\n".join(lines)


def video_facts(video: CameraVideo) -> tuple[dict[str, str], bool]:
    """Return facts about a video by name, and whether its camera is fixed."""
    small: list[np.ndarray] = []

    def frames() -> Iterator[np.ndarray]:
        for rgb in islice(read_frames(video.path), min(MAX_FRAMES, len(video.seconds))):
            small.append(small_brightness(rgb))
            yield rgb

    measures = measure_frames(frames())
    displaced = camera_displacement(np.stack(small))
    with open_video_container(video.path) as container:
        has_sound = len(container.streams.audio) > 0
    gaps = 1000 * np.diff(video.seconds)
    rate = f"{video.rate:.4g} per second"
    if len(gaps) and gaps.max() > UNEVEN * np.median(gaps):
        rate = f"variable rate: {gaps.min():.0f} to {gaps.max():.0f} ms between frames"
    blurred = int((measures.sharpness < BLURRED * np.median(measures.sharpness)).sum())
    facts: dict[str, Any] = {
        "size": f"{video.info.width}x{video.info.height}",
        "frames": f"{len(video.seconds)} in {video.seconds[-1] + 1 / video.rate:.2f} s, {rate}",
        "colours": video.info.colours,
        "sound": "yes" if has_sound else "none",
        "sharpness": format_count(blurred, "blurred frame"),
        "camera": f"moves by up to {displaced:.1%} of its width, {np.median(measures.motion):.2%} from frame to frame",
    }
    stands = displaced <= FIXED_CAMERA_LIMIT
    facts |= {"camera": "fixed"} if stands else {}
    return {name: value for name, value in facts.items() if value}, stands
