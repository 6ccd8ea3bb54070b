"""Checks of a capture; each returns one line per suspicious thing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from statistics import fmean
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import about_pelvis
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.geometry import (
    camera_center,
    focus_point,
    fraction_in_front,
    inverse_rigid,
    projected,
)
from dyngs.data.images.images import read_header, read_image, read_mask
from dyngs.data.times import distinct_times, evenly_spaced

MAX_LINES_PER_KIND = 5  # problems of one kind that are listed; the others are counted
MAX_VIEWS = 300  # views, chosen at random, in which points are looked for
MARGIN = 0.1  # fractions of the image by which a point may lie outside: lenses distort
# degrees between neighbouring views, seen from the scene, from which they are far apart
WIDE_BASELINE = 10.0
CLOSE_IN_TIME, FEW_VIEWS = 0.08, 3
"""Motion over this fraction of a clip is small; with fewer views in it, each time step is seen from
one side only."""
# degrees around a body without a camera from which on a part of it is hardly seen
UNSEEN_SIDE = 200.0


def before_training(capture: Capture) -> list[str]:
    """Return one line for everything about a capture that is likely to spoil a training; only some
    masks are read."""
    masks, problems = masks_of(capture)
    line = [] if masks is None else [f"masks of {masks}"]
    found = [*capture.warnings, *line, *problems, *time_problems(capture), *scene_problems(capture)]
    return list(dict.fromkeys([*found, *body_problems(capture)]))


def time_problems(capture: Capture) -> list[str]:
    """Return the problems of times and of who saw them: a moving scene must be seen from several
    sides."""
    if _is_still_monocular(capture):
        count = len(set(distinct_times(all_views(capture.splits)).values()))
        return [
            f"one camera that does not move saw all {count} times: a moving scene cannot be reconstructed in 3D from "
            "that; move the camera or use several"
        ]
    return _ill_posed(capture)


def body_problems(capture: Capture) -> list[str]:
    """Return a line if no training view shows one side of a captured person, in any frame."""
    body = None if capture.body is None else capture.body["train"]
    if body is None:
        return []
    from scipy.spatial.transform import Rotation  # late: importing it takes a tenth of a second

    body = about_pelvis(body, np.zeros(3) if body.pelvis is None else body.pelvis)
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
        f"the person's {side} is never seen: all cameras are within {360 - gaps[widest]:.0f} degrees around the body; "
        "what they do not see will be a guess (turn around once, or use more cameras)"
    ]


def scene_problems(capture: Capture) -> list[str]:
    """Return the problems of poses and points together: cameras that look away, points that no
    camera sees, .."""
    views = all_views(capture.splits)
    problems = []
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    centers = poses[:, :3, 3]
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    is_still = capture.body is not None or _is_still_monocular(capture)
    if len(poses) > 1 and spread < 1e-9 and not is_still:
        problems.append("all cameras are at one place, so no depth can be found")
    xyz = capture.points.xyz if capture.points is not None else np.zeros((0, 3))
    focus = np.median(xyz, axis=0) if len(xyz) else focus_point(poses)
    what = "the sparse points" if len(xyz) else "each other's scene"
    if focus is not None and fraction_in_front(poses, focus) < 0.5:
        problems.append(
            f"{1 - fraction_in_front(poses, focus):.0%} of the cameras look away from {what}: are the poses in the "
            "axes that the format wants (OpenGL camera-to-world for JSON files)?"
        )
    elif focus is not None and capture.body is None:
        problems += _odd_cameras(views, focus, what)
    if len(xyz):
        problems += _point_problems(xyz, views)
    return problems


def _odd_cameras(views: list[View], center: np.ndarray, what: str) -> list[str]:
    in_image = sum(_lies_in(center[None], view)[0] for view in views)
    local = [view.cam_from_world[2, :3] @ center + view.cam_from_world[2, 3] for view in views]
    away = [view.name for view, depth in zip(views, local, strict=True) if depth <= 0]
    if not away or in_image < 0.9 * len(views):
        return []
    return [
        f"{len(away)} of {len(views)} cameras look away from the centre of {what}, first '{away[0]}'"
    ]


def _point_problems(xyz: np.ndarray, views: list[View]) -> list[str]:
    rng = np.random.default_rng(0)
    sample = xyz[rng.permutation(len(xyz))[:2000]]
    seen = np.zeros(len(sample), bool)
    blind = []
    for index in rng.permutation(len(views))[:MAX_VIEWS]:
        inside = _lies_in(sample, views[index])
        seen |= inside
        if not inside.any():
            blind.append(views[index].name)
    problems = []
    if seen.mean() < 0.9:
        problems.append(f"{1 - seen.mean():.0%} of the points are in no camera's view")
    if blind and seen.mean() >= 0.5:
        problems.append(
            f"{len(blind)} of {min(len(views), MAX_VIEWS)} cameras see none of the points, first '{min(blind)}'"
        )
    distance = np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1)
    far = distance > 50 * max(float(np.median(distance)), 1e-12)
    if far.any():
        problems.append(
            f"{int(far.sum())} of {len(xyz)} points lie more than 50 times farther off than the median one"
        )
    return problems


def _lies_in(points: np.ndarray, view: View) -> np.ndarray:
    """Return (P,) whether points lie in the image or little outside."""
    places, _ = projected(points, view)
    in_front = points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] > 0
    return in_front & (places > -MARGIN).all(axis=1) & (places < 1 + MARGIN).all(axis=1)


def _is_still_monocular(capture: Capture) -> bool:
    """Whether a single camera that does not move took all training views, at several times."""
    views = [view for view in capture.splits.get("train", ()) if view.time is not None]
    poses = {view.cam_from_world.round(9).tobytes() for view in views}
    return capture.body is None and len(poses) == 1 and len(set(distinct_times(views).values())) > 1


def _ill_posed(capture: Capture) -> list[str]:
    """Few images of one time each from places far apart: what moves has moved on before another
    side of it is seen.

    Many such images are no problem (D-NeRF's are all like that): neighbours in time then show
    nearly the same.
    """
    views = sorted(
        (v for v in capture.splits.get("train", ()) if v.time is not None),
        key=lambda v: v.time or 0.0,
    )
    times = set(distinct_times(views).values())
    if (
        capture.body is not None
        or not 3 <= len(views) == len(times)
        or len(times) * CLOSE_IN_TIME >= FEW_VIEWS
    ):
        return []
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    center = focus_point(poses) if capture.points is None else np.median(capture.points.xyz, axis=0)
    if center is None or not np.isfinite(center).all():
        return []
    offsets = poses[:, :3, 3] - center
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1, 1)))
    if angles.mean() < WIDE_BASELINE:
        return []
    return [
        f"{len(views)} images, each at a time of its own, {angles.mean():.0f} degrees apart on average: what moves "
        "is seen from one side only at each time; expect a static result"
    ]


def listed(lines: Iterable[str]) -> list[str]:
    """Return the lines, and a count of those beyond ``MAX_LINES_PER_KIND``."""
    found = list(lines)
    more = len(found) - MAX_LINES_PER_KIND
    return (
        [*found[:MAX_LINES_PER_KIND], f"... and {more} more like the last one"]
        if more > 0
        else found
    )


def problems_of(capture: Capture, deep: bool) -> list[str]:
    """Return a line for everything suspicious, next to the capture's own warnings; ``deep``: decode
    every image."""
    views = all_views(capture.splits)
    train = capture.splits.get("train", ())
    problems = []
    if not capture.splits.get("test"):
        problems.append(
            "the split 'test' is empty, so nothing can be measured (see data.test_every)"
        )
    if len(train) < 3:
        problems.append(f"only {len(train)} training views; a scene needs some 20 or more")
    poses = Counter(view.cam_from_world.round(9).tobytes() for view in views if view.time is None)
    same = sum(count for count in poses.values() if count > 1)
    if same:
        problems.append(f"{same} views of a static scene share their pose with another one")
    problems += listed(
        f"'{view.name}': {fault}"
        for view in views
        if (fault := _fault_of_intrinsics(view)) is not None
    )
    problems += [*_image_problems(capture, deep), *masks_of(capture)[1]]
    return [*problems, *time_problems(capture), *scene_problems(capture), *body_problems(capture)]


def _fault_of_intrinsics(view: View) -> str | None:
    width, height = view.width, view.height
    fx, fy = np.diag(view.intrinsics)[:2]
    cx, cy = view.intrinsics[:2, 2]
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > 0.2:
        return f"the principal point ({cx:g}, {cy:g}) is far from the middle of {width}x{height}"
    if not 0.9 < fx / fy < 1.1:
        return f"the focal lengths ({fx:g}, {fy:g}) px differ by more than 10%"
    if not 0.05 < fx / max(width, height) < 50:
        return f"a focal length of {fx:g} px does not suit a {width}x{height} image"
    return None


def _image_problems(capture: Capture, deep: bool) -> list[str]:
    unreadable = []
    sizes = []
    channels = Counter[int]()
    for view in all_views(capture.splits):
        for path in (view.image_path, view.mask_path):
            if path is None or (view.video is not None and not path.is_file()):
                continue
            try:
                header = read_header(path)
                if deep:
                    read_image(path)
            except DyngsError as error:
                unreadable.append(str(error))
                continue
            if header.size_for((view.width, view.height)) != (view.width, view.height):
                camera = f"its camera says {view.width}x{view.height}"
                sizes.append(f"{path} has {header.width}x{header.height} pixels, {camera}")
            if path == view.image_path:
                channels[header.channels] += 1
    problems = listed(unreadable) + listed(sizes)
    if len(channels) > 1:
        problems.append("images have different numbers of channels: " + tallied(channels))
    return problems


def tallied(counter: Counter[Any]) -> str:
    """Return the most frequent keys with their counts."""
    return ", ".join(
        f"{key} ({count})" if len(counter) > 1 else f"{key}"
        for key, count in counter.most_common(6)
    )


LOOKED_AT = 4  # masks that are read
# fraction of the pixels that masks may ignore before that is suspicious: passers-by fill less
MOST_IGNORED = 0.5


def masks_of(capture: Capture) -> tuple[str | None, list[str]]:
    """Return a description of the masks of a capture, None without any, and a line if they ignore
    most of the pixels.

    A few masks are read; unreadable ones are reported by those who check files.
    """
    views = all_views(capture.splits)
    paths = [view.mask_path for view in views if view.mask_path is not None]
    if not paths:
        return None, []
    found = f"{len(paths)} of {len(views)} images; white counts, black is ignored"
    sample = [paths[index] for index in evenly_spaced(len(paths), LOOKED_AT)]
    try:
        ignored = fmean(1 - float(read_mask(path).float().mean()) for path in sample)
        brightest = max(int(read_image(path)[..., :3].max()) for path in sample)
    except DyngsError:
        return found, []
    found += f": {ignored:.0%} of the pixels in {len(sample)} that were read"
    if ignored <= MOST_IGNORED:
        return found, []
    why = (
        f"they hold no value above {brightest}, but white is 255: are they labels?"
        if brightest < 128
        else "white counts and black is ignored: are they inverted?"
    )
    line = f"masks ignore {ignored:.0%} of the pixels in {len(sample)} that were looked at, first {sample[0]}; {why}"
    return found, [line]
