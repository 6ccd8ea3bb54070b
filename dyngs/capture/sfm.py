"""Camera poses for a folder of photos or a video, by pycolmap's structure from motion on the
CPU."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from dyngs.capture.frame_choice import STILL, chosen_frames, measured
from dyngs.capture.photos import Photo, copied, digest_of, gather_photos, lay_out
from dyngs.capture.sfm_features import find_features, match_pairs, matched_images, pairs_to_match
from dyngs.capture.sfm_mapping import SfmModel, better, mapped, needs_more
from dyngs.capture.sfm_matches import (
    Parallax,
    angles_deg,
    matched_pairs,
    parallax_of,
    turning_fraction,
    without_movers,
)
from dyngs.capture.sfm_work import SfmOptions, SfmTask, quiet_colmap, working
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, counted
from dyngs.data.images.images import read_header
from dyngs.data.images.video import (
    colour_notes,
    frame_seconds,
    probe_video,
    read_frames,
    read_numbered_frames,
)
from dyngs.data.readers.colmap import find_masks, mask_of
from dyngs.data.times import write_seconds
from dyngs.io.containment import images_up_to, inside, staying_within
from dyngs.io.fields import first_few, read_json_object
from dyngs.io.outputs import require_new_folder
from dyngs.io.write import write_image, write_text

_NUM_FRAMES = 100
_SMALL_ANGLE_DEG = 1.0
_TURNS = 0.8
_FEWEST_MATCHED = 3
_MOVING_FRACTION = 0.02
_TURNING = (
    "the images differ only as if the camera rotated on the spot (or all show one flat surface), which gives no "
    "depth; walk sideways around the scene by about a quarter of its distance, and keep it in view"
)


@dataclass(frozen=True)
class SfmResult:
    """Result of pose estimation: a capture in COLMAP's layout in the folder ``root``.

    Attributes:
        unregistered: names of the images without a pose.
        mean_error_px: mean reprojection error.
        mean_track: images in which a point is seen, on average.
        seconds: of each stage, by name.
        notes: lines about choices, and about what to film or photograph better.
    """

    root: Path
    num_images: int
    num_registered: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_error_px: float
    mean_track: float
    mapper: str
    seconds: Mapping[str, float]
    notes: tuple[str, ...]

    def summary(self) -> str:
        """The result as lines of text."""
        stages = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.seconds.items())
        lines = [
            f"{self.num_registered} of {self.num_images} images registered, {self.num_points} points, "
            f"mean error {self.mean_error_px:.2f} px: {self.root}",
            f"a point is seen in {self.mean_track:.1f} images on average; {self.mapper} mapping; {stages}",
        ]
        if self.unregistered:
            lines.append("no pose for " + first_few(self.unregistered))
        return "\n".join((*lines, *self.notes))

    def write(self, folder: Path) -> None:
        """Write the result, without its folder, to ``sfm_report.json``."""
        fields = {
            "images": self.num_images,
            "registered": self.num_registered,
            "unregistered": self.unregistered,
            "points": self.num_points,
            "mean_reprojection_error_px": round(self.mean_error_px, 4),
            "mean_track_length": round(self.mean_track, 2),
            "mapper": self.mapper,
            "seconds": {name: round(seconds, 1) for name, seconds in self.seconds.items()},
            "notes": self.notes,
        }
        write_text(folder / "sfm_report.json", json.dumps(fields, indent=1) + "\n")


@dataclass(frozen=True)
class _Images:
    """The images in ``capture/images``, names of those that are blurred, and lines on what was
    taken."""

    photos: list[Photo]
    blurred: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def estimate_poses(
    source: Path,
    out: Path,
    options: SfmOptions = SfmOptions(),
    report: ReportProgress = report_nothing,
) -> SfmResult:
    """Estimate poses of the images in ``source`` and write a COLMAP capture (``out/images``,
    ``out/sparse/0``).

    Work is done in a hidden folder next to ``out``; it is renamed at the end, so ``out`` is
    complete or absent. A stopped run leaves that folder, and the next one with the same images and
    options goes on with its features and matches. Of several models the one with most images is
    kept. Raises DyngsError: too few images, an ``out`` in use, a camera that stands still or only
    rotates, or nothing could be registered, with advice.

    Args:
        source: a folder of photos (subfolders included) or a video file.
        out: a folder that does not exist, or is empty.
    """
    require_new_folder(out)
    if not source.exists():
        raise DyngsError(f"no such folder of photos or video: {source}")
    if options.masks is not None and not options.masks.is_dir():
        raise DyngsError(f"no such folder of masks: {options.masks}")
    try:
        masks = "" if options.masks is None else digest_of(options.masks)
        with (
            working(out, f"{digest_of(source)} {masks} {replace(options, num_threads=0)}") as work,
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


def _posed_in(
    work: Path, source: Path, out: Path, options: SfmOptions, report: ReportProgress
) -> SfmResult:
    stages: dict[str, float] = {}
    capture = work / "capture"

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        stages[name] = time.perf_counter() - begun

    with timed("images"):
        if source.is_file():
            images = _frames_of(source, capture, options, report)
        else:
            gathered, left_out = gather_photos(source, capture / "images", out)
            images = _Images(gathered, notes=left_out)
    photos = images.photos
    if len(photos) < 3:
        found = "; ".join((f"{source} has {counted(len(photos), 'image')}", *images.notes))
        raise DyngsError(f"{found}; structure from motion needs at least 3, better 30")
    with quiet_colmap():
        with (
            nullcontext()
            if options.masks is None
            else staying_within(options.masks, options.follow_links)
        ):
            task = _laid_out(work, photos, source.is_file(), options, report)
        with timed("features"):
            stronger = find_features(task)
        notes = [*images.notes]
        if stronger > 1:
            notes.append(
                f"features with {stronger:g} times the usual contrast were taken: frames have many"
            )
        with timed("matching"):
            match_pairs(task, pairs_to_match(task))
            notes += _parallax_seen(task)
        with timed("poses"):
            model, more = _mapped(task)
    _require_depth(model, task)
    own = dict(zip(task.names, (photo.name for photo in photos), strict=True))
    lonely = {
        own[name]
        for name, count in matched_images(task.database).items()
        if count < _FEWEST_MATCHED
    }
    missing = _write_model(model, capture, own)
    notes += [*more, *_advice(missing, lonely, images.blurred, task.is_video)]
    found = model.reconstruction
    result = SfmResult(
        out, len(photos), len(photos) - len(missing), missing, found.num_points3D(), model.error_px,
        float(found.compute_mean_track_length()), model.mapper, stages, tuple(notes),
    )  # fmt: skip
    result.write(capture)
    return result


def _laid_out(
    work: Path, photos: list[Photo], is_video: bool, options: SfmOptions, report: ReportProgress
) -> SfmTask:
    folder = work / "capture" / "images"
    found = {} if options.masks is None else find_masks(options.masks)
    masks = {
        photo.name: mask for photo in photos if (mask := mask_of(photo.source, found)) is not None
    }
    if options.masks is not None and not masks:
        raise DyngsError(
            f"{options.masks}: no mask is named as an image is (a.jpg.png, a.jpg or a.png for a.jpg)"
        )
    names = lay_out(photos, folder, work / "images", masks)
    for name, mask in masks.items():
        target = folder.with_name("masks") / (name + mask.suffix)
        if not target.exists():
            copied(inside(mask).resolve(), target)
    used = work / "masks" if masks else None
    return SfmTask(
        work / "database.db", work / "images", names, photos, options, report, is_video, used
    )


def _mapped(task: SfmTask) -> tuple[SfmModel, list[str]]:
    """Return the model, and lines about what was done for it.

    Where it is not good, features that disagree with most of their images are left out, and the
    better one is kept.
    """
    model = mapped(task)
    notes = []
    if model is None or needs_more(model, task):
        still = task.database.with_name("still.db")
        shutil.copyfile(task.database, still)
        fraction = without_movers(still, task.side)
        if fraction >= _MOVING_FRACTION:
            second = mapped(replace(task, database=still))
            best = better(model, second)
            if best is second and second is not None:
                before = (
                    "none"
                    if model is None
                    else f"{counted(model.registered, 'image')}, {model.error_px:.2f} px"
                )
                notes.append(
                    f"{fraction:.0%} of the features move with something else than the scene and were left out: "
                    f"{counted(second.registered, 'image')}, {second.error_px:.2f} px; with them {before}"
                )
            model = best
    if model is None:
        if turning_fraction(task.database) >= _TURNS:
            raise DyngsError(_TURNING)
        raise DyngsError(
            f"no poses could be found for {len(task.names)} images: take sharper ones that overlap by two thirds, move "
            "the camera sideways, do not only rotate it, avoid bare or moving surfaces, or try matching=exhaustive"
        )
    return model, notes


def _parallax_seen(task: SfmTask) -> list[str]:
    """Return a line where the camera hardly moved, or where matches may be of something that moves;
    else none."""
    found = parallax_of(matched_pairs(task.database), task.side)
    if found.kind is Parallax.NONE:
        raise DyngsError(_TURNING)
    if found.may_follow_a_mover:
        return [
            f"matches cover only {found.covered:.0%} of where the images have features: they may be of something "
            "that moves, which the poses then follow; give masks of it (--masks), or film more of what stands"
        ]
    if found.kind is Parallax.ENOUGH:
        return []
    return [
        f"the camera hardly moved: near and far things shift by {found.fraction:.1%} of the image against each other, "
        f"so depth and focal length are uncertain; {_film(task)} while walking sideways by about a quarter of the "
        "distance to the scene"
    ]


def _film(task: SfmTask) -> str:
    return "film" if task.is_video else "take photos"


def _require_depth(model: SfmModel, task: SfmTask) -> None:
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
    if turning_fraction(task.database) >= _TURNS:
        raise DyngsError(_TURNING)
    raise DyngsError(
        f"the camera hardly moved: half of the points are seen from directions less than {max(angle, 0.1):.1f} degrees "
        f"apart, which gives no depth; {_film(task)} while walking sideways by about a quarter of the distance to the "
        "scene"
    )


def _write_model(model: SfmModel, capture: Path, names: dict[str, str]) -> tuple[str, ...]:
    """Write the model with the images' own names; return the names of images without a pose."""
    registered = set()
    for image in model.reconstruction.images.values():
        image.name = names[image.name]
        if image.has_pose:
            registered.add(image.name)
    sparse = capture / "sparse" / "0"
    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir(parents=True)
    model.reconstruction.write(sparse)
    return tuple(name for name in names.values() if name not in registered)


def _advice(
    unregistered: Sequence[str], lonely: set[str], blurred: Sequence[str], is_video: bool
) -> Iterator[str]:
    """Yield lines about what to film better: images without a pose, that match few others, that are
    less sharp."""
    apart = sum(name in lonely for name in unregistered)
    if apart:
        more = "move slower there" if is_video else "take more photos around them"
        yield f"{apart} images without a pose match fewer than three others: {more}"
    if apart < len(unregistered):
        yield (
            f"{len(unregistered) - apart} images without a pose match others, but fit no common scene: things that "
            "move fill them, or the camera only rotated there"
        )
    if blurred:
        more = "more light or a slower hand" if is_video else "take them again"
        yield f"{len(blurred)} images are much less sharp than the others ({first_few(blurred)}): {more}"


def _frames_of(video: Path, capture: Path, options: SfmOptions, report: ReportProgress) -> _Images:
    """Frames of a video, chosen by ``frame_choice``; their seconds are written, too.

    Two passes, so that only one image is held in memory: the first one measures. Frames of a
    stopped run are kept.
    """
    images = capture / "images"
    done = capture.parent / "frames.json"
    if not done.is_file():
        measures = measured(read_frames(video))
        choice = chosen_frames(measures, options.num_frames or _NUM_FRAMES)
        if choice.num_frames >= 3 and choice.reach < STILL:
            raise DyngsError(
                f"{video}: the camera stands still (the image moves by {choice.reach:.2%} of its width), which "
                "gives no depth; film while walking sideways around the scene"
            )
        names = {index: f"frame_{index:05d}.png" for index in choice.numbers}
        for place, (index, rgb) in enumerate(read_numbered_frames(video, choice.numbers)):
            write_image(images / names[index], rgb)
            report("frames of the video", place + 1, len(names))
        seconds = frame_seconds(video, len(measures))
        write_seconds(capture, {name: seconds[index] for index, name in names.items()})
        blurred = [names[index] for index in choice.blurred]
        notes = [*colour_notes([probe_video(video)]), choice.summary()]
        fields = {"names": list(names.values()), "blurred": blurred, "notes": notes}
        write_text(done, json.dumps(fields))
    stored = {
        key: tuple(map(str, cast("list[object]", value)))
        for key, value in read_json_object(done).items()
    }
    photos = [Photo(name, read_header(images / name), name) for name in stored["names"]]
    return _Images(photos, stored["blurred"], stored["notes"])
