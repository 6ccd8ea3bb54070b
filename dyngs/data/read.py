"""Capture reading: format detection, splits, missing files and smaller copies; sets of captures of
people."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError, NoCaptureError, wrap_read_errors
from dyngs.core.plugins import READERS, load_plugin, load_plugins
from dyngs.data import times
from dyngs.data.body_frames import attach_fitted_body
from dyngs.data.capture import (
    Capture,
    CaptureFormat,
    PointCloud,
    Splits,
    View,
    all_views,
    map_views,
)
from dyngs.data.geometry import match_intrinsics_to_image
from dyngs.data.images.images import read_header, target_size, try_read_header
from dyngs.data.images.video import decode_frames
from dyngs.data.readers import (
    camera_folders,
    colmap,
    nerfies,
    neuman,
    people_snapshot,
    photogrammetry,
    transforms,
    zju_mocap,
)
from dyngs.data.scene_space import normalise_capture
from dyngs.io.archive import is_archive, unpack_archive
from dyngs.io.containment import check_inside, restrict_paths_to
from dyngs.io.find import FileFinder, downscaled_image_folders
from dyngs.io.outputs import suggest_command

PEOPLE_FILE = "people.json"
"""File in a set of people with subfolders of folders (shards): the options it was generated
with."""


def list_captures(data: DataConfig) -> list[DataConfig]:
    """Return one config per capture in the subfolders of ``data.root``, or of its shards, sorted
    by name.

    No capture is read. Raises DyngsError if there are no subfolders.
    """
    root = data.root
    shards = _folders(root) if (root / PEOPLE_FILE).is_file() else [root]
    people = [person for shard in shards for person in _folders(shard)]
    if not people:
        raise DyngsError(
            f"{root}: contains no folders; give a folder with one capture of a person per subfolder"
        )
    return [data.model_copy(update={"root": folder}) for folder in people]


def _folders(root: Path) -> list[Path]:
    return (
        sorted(f for f in root.iterdir() if f.is_dir() and not f.name.startswith("."))
        if root.is_dir()
        else []
    )


def view_size(view: View, options: DataConfig) -> tuple[int, int]:
    """Return the (width, height) of a view in training."""
    return target_size(
        view.width, view.height, options.downscale / view.copy_factor, options.longest_side
    )


def describe_shrinking(splits: Splits, options: DataConfig) -> str | None:
    """Return a message if ``longest_side`` shrinks images, and None otherwise."""
    if options.longest_side is None:
        return None
    view = max(all_views(splits), key=lambda view: view.width * view.height * view.copy_factor**2)
    width, height = (side * view.copy_factor for side in (view.width, view.height))
    if max(width, height) <= options.longest_side:
        return None
    small = "x".join(map(str, view_size(view, options)))
    return (
        f"images of {width}x{height} px are shrunk to {small}; data.longest_side=0 keeps their size"
    )


def with_smaller_images(
    root: Path, splits: Splits, options: DataConfig
) -> tuple[Splits, list[str]]:
    """Replace views by the smallest image copies that are large enough for training; also return a
    message.

    Copies are not used if an image has no copy, or has a mask or depth map of its own size.
    """
    images = root / "images"
    copies = downscaled_image_folders(images)
    views = [view for view in all_views(splits) if view.image_path.is_relative_to(images)]
    if not copies or not views:
        return splits, []
    factor = min(max(view.width, view.height) / max(view_size(view, options)) for view in views)
    number = max((number for number in copies if number <= factor), default=0)
    if not number:
        return splits, []
    finder = FileFinder(copies[number])
    small: dict[str, View] = {}
    for view in views:
        copy = _shrunk(view, finder.find(os.path.relpath(view.image_path, images)), number)
        if copy is None:
            return splits, []
        small[view.name] = copy
    line = f"{copies[number].name} is read instead of images, because training uses images of that size or smaller"
    return map_views(splits, lambda view: small.get(view.name, view)), [line]


def _shrunk(view: View, path: Path, factor: int) -> View | None:
    """Return the view with a copy of its image that is ``factor`` times smaller, None if it does
    not fit."""
    if view.mask_path or view.silhouette or view.depth_path or view.motion_mask_path:
        return None
    header = try_read_header(path)
    described = (view.width, view.height)
    stored = (0, 0) if header is None else header.size_matching(described)
    if any(
        abs(factor * small - large) >= factor
        for small, large in zip(stored, described, strict=True)
    ):
        return None
    intrinsics, size, _ = match_intrinsics_to_image(view.intrinsics, described, stored, str(path))
    return replace(
        view,
        image_path=path,
        intrinsics=intrinsics,
        width=size[0],
        height=size[1],
        copy_factor=factor,
    )


# Points with larger coordinates are dropped: their squares exceed the range of float32.
FARTHEST = 1e18

_PRIORS = {
    "depth_path": "depth maps",
    "motion_mask_path": "motion masks",
    "flow_path": "flow fields",
}
"""Fields of views with optional prior files, and their names in messages."""

FORMATS: tuple[CaptureFormat, ...] = (
    transforms.BODY_FORMAT,
    zju_mocap.FORMAT,
    people_snapshot.FORMAT,
    neuman.FORMAT,
    transforms.FORMAT,
    transforms.NERFSTUDIO_FORMAT,
    colmap.FORMAT,
    nerfies.FORMAT,
    photogrammetry.POLYCAM_FORMAT,
    photogrammetry.RECORD3D_FORMAT,
    photogrammetry.METASHAPE_FORMAT,
    photogrammetry.REALITYCAPTURE_FORMAT,
    photogrammetry.ODM_FORMAT,
    camera_folders.FORMAT,
    camera_folders.LLFF_FORMAT,
)
"""All formats in order of priority: the first one that is recognised is read."""
_BUILT_IN = {format.name: format for format in FORMATS}


def read_capture(source: DataConfig | Path | str, decode_videos: bool = True) -> Capture:
    """Read the capture in a folder or .zip; of images only the headers are read.

    Views are sorted by name. ``frames`` of the options selects among the times of all splits,
    ``pose_frames`` the times of the split pose. If the format defines no test views, every
    ``test_every``-th image is one, from ``test_first`` on. Times are scaled to [0, 1] over all
    splits. Poses, points and bodies are in scene coordinates, see
    ``scene_space.normalise_capture``. Splits train, val and test always exist; val and test may be
    empty.

    Example:

        import dyngs
        from dyngs.data.loader import ImageLoader

        capture = dyngs.read_capture("lego")
        image = ImageLoader(capture.splits["train"])[0].to("cpu")
        image.cameras, image.rgb_premultiplied  # the camera and the target image

    Args:
        source: the folder or .zip, or a ``dyngs.config.DataConfig`` with it as ``root`` and
            options such as ``frames``.
        decode_videos: write the selected video frames as image files, see ``images.video``;
            otherwise these files may not exist yet.

    Raises:
        DyngsError: no such folder, no capture in it, or an invalid file, which is named.
    """
    options = source if isinstance(source, DataConfig) else DataConfig(root=Path(source))
    require_folder(options.root)
    root = capture_folder(options.root)
    options = options.model_copy(update={"root": root})
    found = _recognised_formats(root, options.format)
    chosen = _chosen_format(options, found)
    with (
        restrict_paths_to(root, options.follow_links),
        wrap_read_errors(
            root,
            "one of its files is invalid (see `dyngs --debug`); export it again",
        ),
    ):
        capture = _finished(chosen.read(root), options, decode_videos)
    others = [other for other in found if other is not chosen and other.name != chosen.extends]
    if options.format == "auto" and others:
        note = f"read as {chosen.name}; a {others[0].name} capture is also there, choose with data.format"
        capture = replace(capture, warnings=(note, *capture.warnings))
    return capture


def require_folder(root: Path) -> None:
    """Raise NoCaptureError unless the folder or archive exists."""
    if not root.is_dir() and not is_archive(root):
        problem = (
            "is a file; give its folder" if root.is_file() else "no such folder; check data.root"
        )
        raise NoCaptureError(f"{root}: {problem}")


def is_capture(root: Path) -> bool:
    """Whether a folder or archive is recognised as a capture of any format."""
    folder = capture_folder(root)
    return folder.is_dir() and bool(_recognised_formats(folder))


def capture_folder(root: Path) -> Path:
    """Return the folder of a capture: ``root``, or the unpacked archive.

    If an archive contains only a single folder, that folder is returned.
    """
    if not is_archive(root):
        return root
    folder: Path = unpack_archive(root)
    while not _recognised_formats(folder):
        inner = list(folder.iterdir())
        if len(inner) != 1 or not inner[0].is_dir():
            break
        folder = inner[0]
    return folder


def _recognised_formats(folder: Path, wanted: str = "auto") -> list[CaptureFormat]:
    """Return the formats of a folder; those of plug-ins if ``wanted`` or no other is found."""
    with wrap_read_errors(folder, "choose another folder or change its permissions"):
        found = [format for format in FORMATS if format.recognise(folder)]
        if not found or wanted not in ("auto", *_BUILT_IN):
            found += [format for format in _plugin_formats() if format.recognise(folder)]
    return found


def _plugin_formats() -> tuple[CaptureFormat, ...]:
    return load_plugins(READERS, CaptureFormat, tuple(_BUILT_IN))


def _chosen_format(options: DataConfig, found: list[CaptureFormat]) -> CaptureFormat:
    """Return the format of ``options.format``, or the first recognised one for "auto"."""
    if options.format == "auto":
        if not found:
            known = suggest_command(options.root, captures=False)
            if known is not None:
                raise DyngsError(f"{options.root}: no capture found; {known}")
            formats = (*FORMATS, *_plugin_formats())
            looked_for = "; ".join(f"{format.name}: {format.files}" for format in formats)
            raise DyngsError(f"{options.root}: no capture found; looked for {looked_for}")
        return found[0]
    chosen = _BUILT_IN.get(options.format) or load_plugin(READERS, options.format, CaptureFormat)
    if chosen not in found:
        also = f"; it contains a {found[0].name} capture" if found else ""
        raise DyngsError(
            f"{options.root}: no {chosen.name} capture (expected {chosen.files}){also}"
        )
    return chosen


def _finished(capture: Capture, options: DataConfig, decode_videos: bool) -> Capture:
    if options.skip_missing:
        capture = _without_missing(capture)
    capture, notes = _with_splits(capture, options)
    splits, copies = with_smaller_images(capture.root, capture.splits, options)
    for view in all_views(splits):
        _check_places(view)
    splits, tracks, absent = _present_priors(splits, capture.tracks_path)
    if decode_videos:
        frames = {
            view.image_path: view.video for view in all_views(splits) if view.video is not None
        }
        decode_frames(capture.root, frames)
    lacking = _missing(splits)
    has_alpha, layers = _first_image(splits["train"])
    points, more = _finite_points(capture.points)
    warnings = [*capture.warnings, *_check_names(capture.root, splits)]
    capture = replace(
        capture,
        splits=splits,
        points=points,
        tracks_path=tracks,
        points_file=capture.points_file if points is not None else None,
        has_alpha=has_alpha,
        warnings=(*warnings, *lacking, *layers, *notes, *copies, *more, *absent),
    )
    return normalise_capture(
        capture if options.body is None else attach_fitted_body(capture, options.body)
    )


def _is_missing(view: View) -> bool:
    return view.video is None and not view.image_path.is_file()


def _missing(splits: Splits) -> list[str]:
    """Return a message with the number of missing images, none if all exist."""
    views = all_views(splits)
    missing = [view.image_path for view in views if _is_missing(view)]
    return (
        [f"{len(missing)} of {len(views)} images are missing, first {missing[0]}"]
        if missing
        else []
    )


def _without_missing(capture: Capture) -> Capture:
    """Return the capture without views whose images are missing, and with a warning."""
    present: Splits = {}
    for name, views in capture.splits.items():
        present[name] = tuple(view for view in views if not _is_missing(view))
    lines = [f"{line}; their views are skipped" for line in _missing(capture.splits)]
    return replace(capture, splits=present, warnings=(*capture.warnings, *lines))


def require_images(capture: Capture) -> Capture:
    """Return the capture, or raise DyngsError if images are missing."""
    for line in _missing(capture.splits):
        raise DyngsError(f"{line}; restore them, or skip them with data.skip_missing=true")
    return capture


def _with_splits(capture: Capture, options: DataConfig) -> tuple[Capture, list[str]]:
    """Return the capture with final splits and times, and messages about them."""
    splits: Splits = {
        name: tuple(sorted(views, key=lambda view: view.name))
        for name, views in capture.splits.items()
    }
    if not splits.get("train"):
        raise DyngsError(
            f"{capture.root}: the {capture.format} capture has no training views; add posed images"
        )
    if capture.body is not None:
        # The body pose of a view is looked up by its time.
        splits = times.times_from_frame_numbers(splits)
    new_poses = splits.pop("pose", None)
    notes: list[str] = []
    rate = options.frames_per_second
    if options.times == "order":
        splits, line = times.times_from_names(splits, rate)
        notes.append(line)
        capture = replace(capture, times_in_seconds=rate is not None, fps=rate or capture.fps)
    elif rate is not None:
        raise DyngsError(
            f"{capture.root}: data.frames_per_second={rate:g} needs data.times=order (times from "
            "file names)"
        )
    splits = times.assign_camera_ids(splits)
    if options.train_cameras is not None:
        splits = times.split_by_camera(capture.root, splits, options.train_cameras)
        said = tuple(line for line in capture.warnings if line != zju_mocap.FIRST_HELD_OUT)
        capture = replace(capture, warnings=said)
    written = splits
    # Bodies are posed by frame number, so times of people within [0, 1] are not stretched.
    splits, scaled = times.normalize_times(capture.root, splits, stretch=capture.body is None)
    if options.frames is not None:
        splits, _ = times.split_by_frames(capture.root, splits, options.frames)
    splits, constant = times.drop_constant_times(splits)
    notes += [*scaled, *constant, *times.frame_count_warnings(splits)]
    if options.pose_frames is not None:
        capture, splits, new_poses = _with_poses_held_out(
            capture, splits, new_poses, options.pose_frames
        )
    span = times.file_time_span(written, splits)
    seconds = times.clip_seconds(splits, capture.fps)
    if capture.times_in_seconds and span:
        seconds = span[1] - span[0]
    if "test" not in splits:
        views = splits["train"]
        held_out = _held_out(views, options)
        splits["test"] = tuple(view for view in views if view.name in held_out)
        splits["train"] = tuple(view for view in views if view.name not in held_out)
    if not splits["train"]:
        raise DyngsError(
            f"{capture.root}: no training views remain; change data.frames, data.pose_frames or "
            "data.test_every"
        )
    splits.setdefault("val", ())
    if new_poses is not None:
        splits["pose"] = new_poses
    return replace(capture, splits=splits, file_time_span=span, seconds=seconds), notes


def _held_out(views: tuple[View, ...], options: DataConfig) -> set[str]:
    """Return the names of the views that ``test_every`` holds out."""
    every = options.test_every
    if not every:
        return set()
    first = options.test_first
    if first is None and views[0].time is not None:
        # The ends of a clip are trained on, because motion beyond them cannot be extrapolated.
        clip = sorted(views, key=lambda view: (view.camera_id, view.time or 0.0, view.name))
        inner = clip[every // 2 : -1 : every]
        if inner:
            return {view.name for view in inner}
    return {view.name for view in views[first or 0 :: every]}


def _with_poses_held_out(
    capture: Capture, splits: Splits, new_poses: tuple[View, ...] | None, frames: str
) -> tuple[Capture, Splits, tuple[View, ...]]:
    """Move the times selected by ``frames`` to the split pose; return the capture and its splits.

    If some cameras have only test views, the split pose consists of their views.
    """
    if capture.body is None or new_poses is not None:
        raise DyngsError(
            f"{capture.root}: data.pose_frames={frames} only applies to captures of people "
            "without a clip of new poses"
        )
    held, kept = times.split_by_frames(capture.root, splits, frames, "data.pose_frames")
    views = all_views(held)
    trained = {view.camera_id for view in splits["train"]}
    others = {view.camera_id for view in splits.get("test", ())} - trained
    views = tuple(view for view in views if not others or view.camera_id in others)
    return capture.replace(body={**capture.body, "pose": capture.body["train"]}), kept, views


def _check_places(view: View) -> None:
    """Raise DyngsError if an image, mask or map lies outside the capture."""
    image = view.image_path if view.video is None else view.video.video
    priors = (view.depth_path, view.motion_mask_path, view.flow_path)
    for path in (image, view.mask_path, view.silhouette and view.silhouette.path, *priors):
        if path is not None:
            check_inside(path)


def _check_names(root: Path, splits: Splits) -> list[str]:
    named: dict[str, Path] = {}
    for view in all_views(splits):
        if named.setdefault(view.name, view.image_path) != view.image_path:
            raise DyngsError(
                f"{root}: the images {named[view.name]} and {view.image_path} share the view "
                f"name {view.name}; rename one"
            )
    train = {view.image_path for view in splits["train"]}
    leaked = [view.name for view in splits["test"] if view.image_path in train]
    return (
        [f"{len(leaked)} test images are also training images, first {leaked[0]}"] if leaked else []
    )


def _first_image(views: tuple[View, ...]) -> tuple[bool, list[str]]:
    """Return whether the first readable image has alpha, and a message on the chosen EXR layer."""
    for view in views:
        if view.silhouette is not None:
            return True, []
        try:
            header = read_header(view.image_path)
        except DyngsError:
            continue
        return header.alpha is not None, [
            f"EXR layer {header.layer} is used"
        ] if header.layer else []
    return False, []


def _finite_points(points: PointCloud | None) -> tuple[PointCloud | None, list[str]]:
    if points is None:
        return None, []
    keep = (np.abs(points.xyz) < FARTHEST).all(axis=1)
    lost = int((~keep).sum())
    notes = [f"{lost} points with NaN, infinite or huge coordinates are ignored"] if lost else []
    points = PointCloud(points.xyz[keep], points.rgb[keep])
    return (points if len(points.xyz) else None), notes


def _present_priors(splits: Splits, tracks: Path | None) -> tuple[Splits, Path | None, list[str]]:
    """Remove missing prior files from the splits and tracks; return these and a message per
    kind."""
    notes: list[str] = []
    for field, kind in _PRIORS.items():
        paths = [path for view in all_views(splits) if (path := getattr(view, field)) is not None]
        missing = {path for path in paths if not path.is_file()}
        if not missing:
            continue
        notes.append(
            f"{len(missing)} of {len(paths)} {kind} are missing and ignored, first {min(missing)}"
        )
        splits = map_views(
            splits,
            lambda v, at=field, no=missing: replace(v, **{at: None}) if getattr(v, at) in no else v,
        )
    if tracks is not None and not check_inside(tracks).is_file():
        return splits, None, [*notes, f"the tracks {tracks} are missing and ignored"]
    return splits, tracks, notes
