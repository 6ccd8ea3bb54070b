"""What a capture holds, and everything about it that looks wrong: the report behind ``dyngs data inspect``."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.config import DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.geometry.focus import focus_point, share_in_front
from dyngs.data.geometry.poses import camera_center, inverse_rigid, matrix_fault, pose_fault
from dyngs.data.inspection.camera_plot import draw_cameras
from dyngs.data.pictures.images import SUFFIXES, read_header, read_picture
from dyngs.data.times import distinct_times
from dyngs.errors import DyngsError, printable, reading, reason
from dyngs.files.containment import leaving_links, pictures_up_to, staying_within
from dyngs.files.json_files import read_json_object

__all__ = ["InspectReport", "draw_cameras", "format_report", "inspect_capture", "report_on"]

MAX_LINES_PER_KIND = 5
"""Of one kind of problem so many are listed, the rest is counted."""


@dataclass(frozen=True)
class InspectReport:
    """What was found.

    Attributes:
        root: the capture folder.
        capture: what the reader returned, None where it refused.
        facts: (name, value) pairs for people, in order.
        problems: everything suspicious, one line each; empty for a capture that looks right.
    """

    root: Path
    capture: Capture | None
    facts: tuple[tuple[str, str], ...]
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        return not self.problems


def inspect_capture(source: Path | DataConfig, deep: bool = False) -> InspectReport:
    """A report on the capture at ``source``; never fails on a bad capture, whose faults are its problems.

    Args:
        source: the folder, or the options by which it would be read.
        deep: decode every picture in full instead of its header only, and videos to files (slow, finds truncated
            files); otherwise frames that no earlier command has decoded are not looked at.
    """
    from dyngs.data.read import read_capture

    options = source if isinstance(source, DataConfig) else DataConfig(root=source)  # type: ignore[call-arg]
    links = [f"{path}: a link that leads out of the capture, to {place}" for path, place in leaving_links(options.root)]
    try:
        capture = read_capture(options, decode_videos=deep)
        with pictures_up_to(options.max_megapixels), reading(options.root, "`dyngs --debug` shows where"):
            report = report_on(capture, deep)
    except DyngsError as error:
        more = (*_listed(links, str), *_loose_json_problems(options.root, str(error)))
        return InspectReport(options.root, None, (), (str(error), *more))
    return replace(report, problems=(*_listed(links, str), *report.problems))


def report_on(capture: Capture, deep: bool = False) -> InspectReport:
    """The report on a capture that could be read; see ``inspect_capture``."""
    problems = list(capture.warnings)
    for check in (_split_problems, _name_problems, _pose_problems, _intrinsics_problems, _time_problems):
        problems += check(capture)
    problems += _picture_problems(capture, deep)
    rigid = [view for view in _all_views(capture) if pose_fault(view) is None]
    if rigid:
        problems += _scene_problems(capture, np.stack([inverse_rigid(view.cam_from_world) for view in rigid]), rigid)
    return InspectReport(capture.root, capture, _facts(capture), tuple(dict.fromkeys(problems)))


def format_report(report: InspectReport) -> str:
    """The report as plain text, several lines."""
    width = max((len(name) for name, _ in report.facts), default=0)
    lines = [f"capture {report.root}"]
    lines += [f"  {name:<{width}}  {value}" for name, value in report.facts]
    if report.ok:
        lines.append("nothing suspicious")
    else:
        lines.append(f"suspicious ({len(report.problems)}):")
        lines += [f"  - {printable(problem)}" for problem in report.problems]
    return "\n".join(lines)


def _facts(capture: Capture) -> tuple[tuple[str, str], ...]:
    views = _all_views(capture)
    sizes = Counter(f"{view.width}x{view.height}" for view in views)
    lenses = Counter(view.lens.model for view in views)
    focal_px = [float(f) for view in views for f in (view.intrinsics[0, 0], view.intrinsics[1, 1])]
    fov_deg = [float(np.degrees(2 * np.arctan2(0.5 * view.width, view.intrinsics[0, 0]))) for view in views]
    centers = np.array([camera_center(view.cam_from_world) for view in views]).reshape(-1, 3)
    facts = [
        ("format", capture.format),
        ("views", ", ".join(f"{len(views)} {split}" for split, views in capture.splits.items() if views)),
        ("sizes", _counted(sizes)),
        ("cameras", str(len({view.camera_id for view in views}))),
        ("focal length", f"{_range(focal_px)} px"),
        ("field of view", f"{_range(fov_deg)} degrees across"),
        ("lens", _counted(lenses)),
        ("alpha", "transparent background" if capture.has_alpha else "none"),
        ("masks", str(sum(view.mask_path is not None for view in views))),
        *_time_facts(capture),
        ("points", str(len(capture.points.xyz)) if capture.points is not None else "none"),
    ]
    if len(centers):
        spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
        box = ", ".join(_range(axis) for axis in centers.T)
        facts.append(("camera centres", f"{box}; within {spread:.4g} of their mean"))
    if np.any(capture.world_offset):
        facts.append(("world offset", " ".join(f"{x:.10g}" for x in capture.world_offset) + " (rebased)"))
    if capture.body is not None:
        frames = ", ".join(
            f"{len(capture.body[name].frames)} {name}" for name in capture.splits if name in capture.body
        )
        facts.append(("body", f"{next(iter(capture.body.values())).kind}, frames: {frames}"))
    return tuple(facts)


def _time_facts(capture: Capture) -> Iterator[tuple[str, str]]:
    """Distinct times, their rate, cameras by times, and how much of videos is decoded."""
    views = [view for view in _all_views(capture) if view.time is not None]
    if not views:
        yield "times", "none (a still scene)"
        return
    times = set(distinct_times(views).values())
    yield "times", f"{len(times)} in {_range(times)}"
    cameras: defaultdict[int, set[bytes]] = defaultdict(set)
    for view in views:
        cameras[view.camera_id].add(view.cam_from_world.round(9).tobytes())
    what = "camera" + ("s" if len(cameras) > 1 else "")
    moving = sum(len(poses) > 1 for poses in cameras.values())
    motion = "" if not moving else " (moving)" if moving == len(cameras) else f" ({moving} moving)"
    yield "sequence", f"{len(cameras)} {what}{motion} x {len(times)} times, {len(views)} pictures"
    if capture.fps is not None:
        yield "frame rate", f"{capture.fps:.6g} per second"
    frames = [view.image_path for view in views if view.video is not None]
    if frames:
        yield "video frames", f"{sum(path.is_file() for path in frames)} of {len(frames)} are decoded already"


def _split_problems(capture: Capture) -> list[str]:
    problems = []
    if not capture.splits.get("test"):
        problems.append("the split 'test' is empty, so nothing can be measured (see data.test_every)")
    if len(capture.splits.get("train", ())) < 3:
        problems.append(f"only {len(capture.splits.get('train', ()))} training views; a scene needs some 20 or more")
    return problems


def _name_problems(capture: Capture) -> list[str]:
    """Names or pictures that occur more than once."""
    views = _all_views(capture)
    names = Counter(view.name for view in views)
    pictures = Counter(view.image_path for view in views)
    doubled = _listed(
        (n for n, count in names.items() if count > 1), lambda n: f"the name '{n}' occurs {names[n]} times"
    )
    shared = _listed(
        (p for p, count in pictures.items() if count > 1), lambda p: f"{p} is the picture of {pictures[p]} views"
    )
    return doubled + shared


def _pose_problems(capture: Capture) -> list[str]:
    views = _all_views(capture)
    problems = _listed((fault for fault in map(pose_fault, views) if fault is not None), str)
    poses = Counter(view.cam_from_world.round(9).tobytes() for view in views if view.time is None)
    same = sum(count for count in poses.values() if count > 1)
    if same:
        problems.append(f"{same} views of a still scene share their pose with another one")
    return problems


def _intrinsics_problems(capture: Capture) -> list[str]:
    def faults() -> Iterator[str]:
        for view in _all_views(capture):
            k, width, height = view.intrinsics, view.width, view.height
            fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
            if not np.isfinite(k).all() or fx <= 0 or fy <= 0:
                yield f"'{view.name}': the focal length ({fx:g}, {fy:g}) px is not a positive number"
            elif not (0 <= cx <= width and 0 <= cy <= height):
                yield f"'{view.name}': the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} picture"
            elif max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > 0.2:
                yield f"'{view.name}': the principal point ({cx:g}, {cy:g}) is far from the middle of {width}x{height}"
            elif not 0.9 < fx / fy < 1.1:
                yield f"'{view.name}': the focal lengths ({fx:g}, {fy:g}) px differ by more than 10%"
            elif not 0.05 < fx / max(width, height) < 50:
                yield f"'{view.name}': a focal length of {fx:g} px does not suit a {width}x{height} picture"

    return _listed(faults(), str)


def _time_problems(capture: Capture) -> list[str]:
    views = _all_views(capture)
    timed = [view for view in views if view.time is not None]
    problems = _listed(
        (view for view in timed if not 0 <= (view.time or 0.0) <= 1),
        lambda view: f"'{view.name}': the time {view.time} is outside [0, 1]",
    )
    if timed and len(timed) < len(views):
        problems.append(f"{len(views) - len(timed)} of {len(views)} views have no time")
    if _is_still_monocular(capture):
        count = len(set(distinct_times(timed).values()))
        problems.append(
            f"one camera that does not move saw all {count} times: a moving scene cannot be reconstructed in 3D from "
            "that; move the camera or use several"
        )
    return problems


def _is_still_monocular(capture: Capture) -> bool:
    """Whether all training views are of one camera in one pose, at several times."""
    views = [view for view in capture.splits.get("train", ()) if view.time is not None]
    poses = {view.cam_from_world.round(9).tobytes() for view in views}
    return capture.body is None and len(poses) == 1 and len(set(distinct_times(views).values())) > 1


def _picture_problems(capture: Capture, deep: bool) -> list[str]:
    """Pictures and masks that are missing, unreadable, or of another size than their camera says."""
    unreadable, sizes, channels = [], [], Counter[int]()
    for view in _all_views(capture):
        for path in (view.image_path, view.mask_path):
            if path is None or (view.video is not None and not path.is_file()):
                continue
            try:
                header = read_header(path)
                if deep:
                    read_picture(path)
            except DyngsError as error:
                unreadable.append(str(error))
                continue
            if (header.width, header.height) != (view.width, view.height):
                camera = f"its camera says {view.width}x{view.height}"
                sizes.append(f"{path} has {header.width}x{header.height} pixels, {camera}")
            if path == view.image_path:
                channels[header.channels] += 1
    problems = _listed(unreadable, str) + _listed(sizes, str)
    if len(channels) > 1:
        problems.append("pictures have different numbers of channels: " + _counted(channels))
    return problems


def _scene_problems(capture: Capture, poses: np.ndarray, views: list[View]) -> list[str]:
    """What poses and points together say: cameras that look away, points that nobody sees or that lie far off."""
    problems = []
    centers = poses[:, :3, 3]
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    if len(poses) > 1 and spread < 1e-9 and capture.body is None and not _is_still_monocular(capture):
        problems.append("all cameras are at one place, so no depth can be found")
    xyz = capture.points.xyz if capture.points is not None else np.zeros((0, 3))
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        problems.append(f"{int((~finite).sum())} of {len(xyz)} points hold NaN or infinity")
    xyz = xyz[finite]
    focus = np.median(xyz, axis=0) if len(xyz) else focus_point(poses)
    if focus is not None and share_in_front(poses, focus) < 0.5:
        what = "the sparse points" if len(xyz) else "each other's scene"
        problems.append(
            f"{1 - share_in_front(poses, focus):.0%} of the cameras look away from {what}: are the poses in the axes "
            "that the format wants (OpenGL camera-to-world for JSON files)?"
        )
    if len(xyz):
        problems += _point_problems(xyz, poses, views)
    return problems


def _point_problems(xyz: np.ndarray, poses: np.ndarray, views: list[View]) -> list[str]:
    """Points outside every picture, and points much farther off than the others (a sample of both)."""
    rng = np.random.default_rng(0)
    sample = xyz[rng.permutation(len(xyz))[:2000]]
    seen = np.zeros(len(sample), bool)
    for index in rng.permutation(len(views))[:300]:
        view, world_from_cam = views[index], poses[index]
        local = (sample - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
        depth = np.where(local[:, 2] > 0, local[:, 2], np.inf)
        x, y = (local[:, :2] / depth[:, None]).T
        k, margin = view.intrinsics, 0.1
        u, v = (k[0, 0] * x + k[0, 2]) / view.width, (k[1, 1] * y + k[1, 2]) / view.height
        inside = (u > -margin) & (u < 1 + margin) & (v > -margin) & (v < 1 + margin)
        seen |= np.isfinite(depth) & inside
    problems = []
    if seen.mean() < 0.9:
        problems.append(f"{1 - seen.mean():.0%} of the points are in no camera's view")
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    far = distance > 50 * max(float(np.median(distance)), 1e-12)
    if far.any():
        problems.append(f"{int(far.sum())} of {len(xyz)} points lie more than 50 times farther off than the median one")
    return problems


def _loose_json_problems(root: Path, known: str) -> list[str]:
    """What is wrong with the frames of ``transforms*.json`` files that the reader refused, beyond what is ``known``."""
    problems = []
    for file in sorted(root.glob("transforms*.json")) if root.is_dir() else []:
        try:
            with staying_within(root):
                frames: Any = read_json_object(file).get("frames", [])
            with reading(file):
                entries = [(str(frame["file_path"]), np.array(frame["transform_matrix"], float)) for frame in frames]
                names = Counter(name for name, _ in entries)
                missing = [n for n in names if not any((root / (n + suffix)).is_file() for suffix in ("", *SUFFIXES))]
        except DyngsError as error:
            if str(file) not in known:
                why = reason(error.__cause__ or error)
                problems.append(f"{file}: holds no frames with 'file_path' and 'transform_matrix' ({why})")
            continue
        faults = (matrix_fault(pose, f"{file}: '{name}'") for name, pose in entries)
        doubled = ((n, count) for n, count in names.items() if count > 1)
        if not entries:
            problems.append(f"{file} lists no frames")
        problems += _listed(missing, lambda n: f"{root / n}: no such picture")
        problems += _listed((fault for fault in faults if fault is not None), str)
        problems += _listed(doubled, lambda item: f"the name '{item[0]}' occurs {item[1]} times")
    return [line for line in problems if line not in known]


def _listed(items: Iterable[Any], line: Callable[[Any], str]) -> list[str]:
    """One line per item, a count in place of those beyond ``MAX_LINES_PER_KIND``."""
    lines = [line(item) for item in items]
    if len(lines) <= MAX_LINES_PER_KIND:
        return lines
    return [*lines[:MAX_LINES_PER_KIND], f"... and {len(lines) - MAX_LINES_PER_KIND} more like the last one"]


def _all_views(capture: Capture) -> list[View]:
    return [view for views in capture.splits.values() for view in views]


def _range(values: Iterable[float]) -> str:
    listed = list(values)
    if not listed:
        return "none"
    low, high = min(listed), max(listed)
    return f"{low:.4g}" if np.isclose(low, high) else f"{low:.4g} to {high:.4g}"


def _counted(counter: Counter[Any]) -> str:
    return ", ".join(f"{key} ({count})" if len(counter) > 1 else f"{key}" for key, count in counter.most_common(6))
