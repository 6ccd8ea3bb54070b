"""Camera poses for a folder of photos or a video, by pycolmap's structure from motion on the CPU."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from dyngs.capture.frame_choice import STILL, FrameChoice, chosen_frames, measured
from dyngs.capture.photos import Photo, copied, digest_of, gather_photos, lay_out
from dyngs.capture.sfm_features import (
    ALIKE,
    ALIKE_PHOTOS,
    FeatureTask,
    alike_pairs,
    all_pairs,
    find_features,
    match_pairs,
    matched_images,
    neighbour_pairs,
)
from dyngs.capture.sfm_mapping import Mapper, MappingTask, Model, better, mapped, needs_more
from dyngs.capture.sfm_matches import Parallax, angles_deg, matched_pairs, parallax_of, turning_fraction, without_movers
from dyngs.capture.sfm_work import SfmOptions, SfmResult, advice, quiet_colmap, working, write_report
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.images.images import read_header
from dyngs.data.images.video import frame_seconds, read_frames, read_numbered_frames
from dyngs.data.readers.colmap import find_masks, mask_of
from dyngs.data.times import write_seconds
from dyngs.errors import DyngsError, counted
from dyngs.files.containment import images_up_to, inside, staying_within
from dyngs.files.fields import read_json_object
from dyngs.files.outputs import require_new_folder
from dyngs.files.write import write_image, write_text

if TYPE_CHECKING:
    import pycolmap

_EXHAUSTIVE_PHOTOS = 60
_EXHAUSTIVE_FRAMES = 24
_ENOUGH_FEATURES = 4000
_SMALL_ANGLE_DEG = 1.0
_TURNS = 0.8
_FEWEST_MATCHED = 3
_MOVING_FRACTION = 0.02


def estimate_poses(
    source: Path, out: Path, options: SfmOptions = SfmOptions(), report: ReportProgress = report_nothing
) -> SfmResult:
    """Estimate poses of the images in ``source`` and write a COLMAP capture (``out/images``, ``out/sparse/0``).

    Work is done in a hidden folder beside ``out``; the capture is renamed at the end, so ``out`` is whole or absent. A
    stopped run leaves that folder, and the next one with the same images and options goes on with its features and
    matches. Of several models the one with most images is kept.

    Args:
        source: a folder of photos (subfolders included) or a video file.
        out: a folder that does not exist, or is empty.
        options: lens model, matching, effort.

    Raises:
        DyngsError: too few images, an ``out`` in use, a camera that stands still or only rotates, or nothing could be
            registered, with advice.
    """
    require_new_folder(out)
    if not source.exists():
        raise DyngsError(f"no such folder of photos or video: {source}")
    if options.masks is not None and not options.masks.is_dir():
        raise DyngsError(f"no such folder of masks: {options.masks}")
    try:
        masks = "" if options.masks is None else digest_of(options.masks)
        task = f"{digest_of(source)} {masks} {replace(options, num_threads=0)}"
        with (
            working(out, task) as (work, _),
            staying_within(source, options.follow_links or source.is_file()),
            images_up_to(options.max_megapixels),
        ):
            result = _posed_in(work, source, out, options, report)
            if out.exists():
                out.rmdir()
            os.replace(work / "capture", out)
        return result
    except OSError as error:
        raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error


@contextmanager
def _timed(stages: dict[str, float], name: str) -> Iterator[None]:
    """Note the seconds of the block as those of a stage."""
    begun = time.perf_counter()
    yield
    stages[name] = time.perf_counter() - begun


@dataclass(frozen=True)
class _Images:
    """The images in ``capture/images``, and what is known of them before matching."""

    photos: list[Photo]
    is_video: bool
    blurred: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def _posed_in(work: Path, source: Path, out: Path, options: SfmOptions, report: ReportProgress) -> SfmResult:
    """Write the capture for ``out`` in ``work/capture`` and return the result."""
    stages: dict[str, float] = {}
    capture = work / "capture"
    with _timed(stages, "images"):
        if source.is_file():
            images = _frames_of(source, capture, options, report)
        else:
            gathered, left_out = gather_photos(source, capture / "images", out)
            images = _Images(gathered, is_video=False, notes=left_out)
    photos = images.photos
    if len(photos) < 3:
        found = "; ".join((f"{source} has {counted(len(photos), 'image')}", *images.notes))
        raise DyngsError(f"{found}; structure from motion needs at least 3, better 30")
    with quiet_colmap(options.seed):
        with nullcontext() if options.masks is None else staying_within(options.masks, options.follow_links):
            features = _feature_task(work, images, options)
        seen = _matched(features, images.is_video, (stages, report))
        with _timed(stages, "poses"):
            first = "global" if images.is_video else "incremental"
            model, notes = _mapped(work, features, first, report)
    _require_depth(model, features.database, images.is_video)
    names = dict(zip(features.names, (photo.name for photo in photos), strict=True))
    matched = {names[name]: count for name, count in matched_images(features.database).items()}
    lonely = [name for name, count in matched.items() if count < _FEWEST_MATCHED]
    missing = _write_model(model, capture, names)
    notes = (*images.notes, *seen, *notes, *advice(missing, lonely, images.blurred, images.is_video))
    found = model.reconstruction
    result = SfmResult(
        out, len(photos), len(photos) - len(missing), missing, found.num_points3D(), model.error_px,
        float(found.compute_mean_track_length()), model.mapper, stages, notes,
    )  # fmt: skip
    write_report(capture, result)
    capture.chmod(0o755)
    return result


def _feature_task(work: Path, images: _Images, options: SfmOptions) -> FeatureTask:
    """Lay the images out for COLMAP."""
    folder, photos = work / "capture" / "images", images.photos
    found = {} if options.masks is None else find_masks(options.masks)
    masks = {photo.name: mask for photo in photos if (mask := mask_of(photo.source, found)) is not None}
    if options.masks is not None and not masks:
        raise DyngsError(f"{options.masks}: no mask is named as an image is (a.jpg.png, a.jpg or a.png for a.jpg)")
    names = lay_out(photos, folder, work / "images", masks)
    for name, mask in masks.items():
        target = folder.with_name("masks") / (name + mask.suffix)
        if not target.exists():
            copied(inside(mask).resolve(), target)
    return FeatureTask(
        work / "database.db", work / "images", names, photos, options, work / "masks" if masks else None,
        _is_single(images, options), _ENOUGH_FEATURES if images.is_video else 0,
    )  # fmt: skip


def _is_single(images: _Images, options: SfmOptions) -> bool:
    """Whether all images share one lens: told so, a video, or the same size, camera and focal length."""
    if options.single_camera is not None:
        return options.single_camera
    kinds = {(p.header.upright_size, p.header.tags.model, p.header.tags.focal_px) for p in images.photos}
    return images.is_video or len(kinds) == 1


def _matched(task: FeatureTask, is_video: bool, told: tuple[dict[str, float], ReportProgress]) -> tuple[str, ...]:
    """Find features and match pairs; those of a stopped run are kept. Return lines about them."""
    stages, report = told
    with _timed(stages, "features"):
        stronger = find_features(task, report)
    with _timed(stages, "matching"):
        match_pairs(task, _pairs(task, is_video), report)
        notes = _parallax_seen(task, is_video)
    if stronger > 1:
        notes = (f"features with {stronger:g} times the usual contrast were taken: frames have many", *notes)
    return notes


def _pairs(task: FeatureTask, is_video: bool) -> list[tuple[int, int]]:
    """Return the pairs to match, by places in the order of names."""
    options, count = task.options, len(task.names)
    limit = _EXHAUSTIVE_FRAMES if is_video else _EXHAUSTIVE_PHOTOS
    if options.matching == "exhaustive" or (options.matching == "auto" and count <= limit):
        return all_pairs(count)
    near = neighbour_pairs(count, options.overlap)
    if options.matching == "sequential":
        return near
    return near + alike_pairs(task.database, task.names, ALIKE if is_video else ALIKE_PHOTOS)


def _mapped(work: Path, features: FeatureTask, first: Mapper, report: ReportProgress) -> tuple[Model, tuple[str, ...]]:
    """Return the model, and lines about what was done for it.

    Where it is not good, features that disagree with most of their images are left out, and the better one is kept.
    ``first`` is the mapping that is tried first.
    """
    options, count = features.options, len(features.names)
    task = MappingTask(
        features.database, features.images, work / "models", count, features.side, options.seed, report, first,
    )  # fmt: skip
    model, notes = mapped(task, options.mapper), ()
    if model is None or needs_more(model, task):
        still = work / "still.db"
        shutil.copyfile(features.database, still)
        fraction = without_movers(still, features.side)
        if fraction >= _MOVING_FRACTION:
            second = mapped(replace(task, database=still), options.mapper)
            best = better(model, second)
            if best is second and second is not None:
                before = "none" if model is None else f"{counted(model.registered, 'image')}, {model.error_px:.2f} px"
                notes = (
                    f"{fraction:.0%} of the features move with something else than the scene and were left out: "
                    f"{counted(second.registered, 'image')}, {second.error_px:.2f} px; with them {before}",
                )
            model = best
    if model is None:
        if turning_fraction(features.database) >= _TURNS:
            raise DyngsError(_TURNING)
        raise DyngsError(
            f"no poses could be found for {count} images: take sharper ones that overlap by two thirds, move "
            "the camera sideways, do not only rotate it, avoid bare or moving surfaces, or try matching=exhaustive"
        )
    return model, notes


_TURNING = (
    "the images differ only as if the camera rotated on the spot (or all show one flat surface), which gives no "
    "depth; walk sideways around the scene by about a quarter of its distance, and keep it in view"
)


def _parallax_seen(task: FeatureTask, is_video: bool) -> tuple[str, ...]:
    """Return a line where the camera hardly moved, or where matches may be of something that moves; else none."""
    found = parallax_of(matched_pairs(task.database), task.side)
    if found.kind is Parallax.NONE:
        raise DyngsError(_TURNING)
    if found.may_follow_a_mover:
        return (
            f"matches cover only {found.covered:.0%} of where the images have features: they may be of something "
            "that moves, which the poses then follow; give masks of it (--masks), or film more of what stands",
        )
    if found.kind is Parallax.ENOUGH:
        return ()
    return (
        f"the camera hardly moved: near and far things shift by {found.fraction:.1%} of the image against each other, "
        f"so depth and focal length are uncertain; {'film' if is_video else 'take photos'} while walking sideways by "
        "about a quarter of the distance to the scene",
    )


def _require_depth(model: Model, database: Path, is_video: bool) -> None:
    """Check that points are seen from directions that differ, by a lens that there can be."""
    if not model.has_real_lens:
        raise DyngsError(
            "no lens that there can be fits the matches: most of them are probably on something that moves, as a "
            "person who fills much of the images; give masks of it (--masks), or film what stands"
        )
    angles = angles_deg(model.reconstruction)
    angle = float(np.median(angles)) if len(angles) else 0.0
    if angle >= _SMALL_ANGLE_DEG:
        return
    if turning_fraction(database) >= _TURNS:
        raise DyngsError(_TURNING)
    raise DyngsError(
        f"the camera hardly moved: half of the points are seen from directions less than {max(angle, 0.1):.1f} degrees "
        f"apart, which gives no depth; {'film' if is_video else 'take photos'} while walking sideways by about a "
        "quarter of the distance to the scene"
    )


def _write_model(model: Model, capture: Path, names: dict[str, str]) -> tuple[str, ...]:
    """Write the model with the images' own names; return the names of images without a pose."""
    found: pycolmap.Reconstruction = model.reconstruction
    registered = set()
    for image in found.images.values():
        image.name = names[image.name]
        if image.has_pose:
            registered.add(image.name)
    sparse = capture / "sparse" / "0"
    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir(parents=True)
    found.write(sparse)
    return tuple(name for name in names.values() if name not in registered)


def _frames_of(video: Path, capture: Path, options: SfmOptions, report: ReportProgress) -> _Images:
    """Frames of a video, chosen by ``frame_choice``; their seconds are written, too.

    Two passes, so that only one image is held in memory: the first one measures. Frames of a stopped run are kept.
    """
    images, done = capture / "images", capture.parent / "frames.json"
    if not done.is_file():
        measures = measured(read_frames(video))
        choice = chosen_frames(measures, options.num_frames)
        _require_motion(video, choice)
        for place, (index, rgb) in enumerate(read_numbered_frames(video, choice.numbers)):
            write_image(images / _frame_name(index), rgb)
            report("frames of the video", place + 1, len(choice.numbers))
        seconds = frame_seconds(video, len(measures))
        write_seconds(capture, {_frame_name(index): seconds[index] for index in choice.numbers})
        fields = {"names": map(_frame_name, choice.numbers), "blurred": map(_frame_name, choice.blurred)}
        write_text(
            done, json.dumps({key: list(names) for key, names in fields.items()} | {"notes": [choice.summary()]})
        )
    stored = {key: tuple(map(str, cast("list[object]", value))) for key, value in read_json_object(done).items()}
    photos = [Photo(name, read_header(images / name), name) for name in stored["names"]]
    return _Images(photos, True, stored["blurred"], stored["notes"])


def _frame_name(index: int) -> str:
    return f"frame_{index:05d}.png"


def _require_motion(video: Path, choice: FrameChoice) -> None:
    if choice.num_frames >= 3 and choice.reach < STILL:
        raise DyngsError(
            f"{video}: the camera stands still (the image moves by {choice.reach:.2%} of its width), which "
            "gives no depth; film while walking sideways around the scene"
        )
