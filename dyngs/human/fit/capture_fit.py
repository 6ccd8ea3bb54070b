"""The fit of a whole capture: reads silhouettes and given poses, fits the body, judges the result
on views left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.conventions import ReportProgress
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import numbered
from dyngs.data.capture import Capture, Split, View
from dyngs.data.loader import Image, ImageLoader
from dyngs.gaussians.parameters import Parameters
from dyngs.human.body.body import BodyTemplate
from dyngs.human.fit.keypoints import Joints3D, Keypoints
from dyngs.human.fit.silhouettes import ObservedFrame, longest_box_side, observed_frame, surface_of
from dyngs.human.fit.solve import (
    FRAMES,
    BodyFit,
    Fitting,
    InTurn,
    LensFit,
    body_fit,
    drawn_frame,
    fit_lens,
    near_given,
    new_fit,
    usual,
)
from dyngs.human.fit.start import first_poses, num_ticks
from dyngs.human.motion.motion import CapturedMotion, MotionClip, captured_motion

IMAGE_SIDE = 512  # longest side of the images that are read, px
RESOLUTION = 48  # texels per side of the atlas whose discs are drawn
MOST_VIEWS = 8  # views of one frame that are looked at
GAIN, GAIN_OF_SHAPE = 0.01, 0.03
"""Gain of IoU for which more is learned, and for which given poses are touched at all.

Below the first, renders of new poses were worse by 0.1 to 0.3 dB on two people. A body of another
shape explains thick clothes, too: with exact poses it gained 0.02, and lost 2.7 dB in new poses.
"""
# most steps of Adam in which a clip is moved to its silhouettes: three numbers are learned
PLACING = 40
TRIAL, PROMISING = 4, 0.75
"""What is tried next is learned in the last of so many parts of its steps at first, when rates are
low, and in all of them where that gains this fraction of ``GAIN``. Where a limb is off, it gains
several times that."""
LONGER, HIGHER = 3, 0.3
"""Poses that were found frame by frame are off by more than given ones: they get so many times the
steps, at rates of 10 to this power times as much at first. Found in 20 frames of four people."""
MOST_OF_THE_BORDER = 0.6
"""Mean fraction of the outermost pixels of images beyond which a silhouette is that of the
background: people who are cut off on three sides cover less."""
SHAPE = ("log_scale", "betas", "padding", "offset", "shift")  # what is the same in all frames


@dataclass(frozen=True)
class FitEffort:
    """How much a fit may cost."""

    side: int = 128  # of the squares around the person that are looked at, px
    steps: int = 120  # least number of steps of Adam of a stage
    visits: int = 18  # how often a frame is drawn where its pose is learned

    def steps_for(self, clip: MotionClip) -> int:
        """Return the number of steps that draws every frame often enough."""
        return max(self.steps, -(-self.visits * len(clip) // FRAMES))


@dataclass(frozen=True)
class Known:
    """What is known next to images and given poses."""

    # in 3D, of frames of the capture, see ``dyngs.human.fit.keypoints``; None without
    joints: Joints3D | None = None
    # the capture is one camera that stands at the origin, with a guessed focal length to be refined
    guessed_lens: bool = False
    shape: bool = False  # the body has the shape of the person already

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of what is learned for all frames; one camera does not tell a small person from a
        distant one."""
        fixed = ("log_scale",) * self.guessed_lens + ("betas",) * self.shape
        return tuple(name for name in SHAPE if name not in fixed)


@dataclass(frozen=True)
class TriedFit:
    """One way to fit."""

    name: str  # for people
    learned: Parameters  # of the clip
    iou: float  # mean IoU of drawn and seen silhouettes
    per_frame: tuple[float, ...]  # (F,) the same, per frame


@dataclass(frozen=True)
class CaptureFit:
    """A fit of a capture's clip of training."""

    fit: BodyFit  # of the clip
    motion: CapturedMotion  # the given clip, F frames
    chosen: TriedFit  # the candidate that was taken
    tried: tuple[TriedFit, ...]  # all candidates; the first one has the poses as given
    # views left out of the fit, on which the candidates were measured; 0: measured on those fitted
    # to
    held_out: int
    # the focal length of one fixed camera that was guessed; None where cameras are known
    lens: LensFit | None = None


@dataclass(frozen=True)
class Seen:
    """What is looked at, by row of the clip: frames to fit to, and frames to judge by."""

    used: dict[int, ObservedFrame | None]
    judged: dict[int, ObservedFrame | None]
    held_out: int

    def with_positions(self, positions: Mapping[int, Tensor]) -> Seen:
        """Return the same with joints given in 3D, by row."""
        used = {
            row: None if frame is None else replace(frame, positions=positions.get(row))
            for row, frame in self.used.items()
        }
        return replace(self, used=used, judged=used if self.judged is self.used else self.judged)

    @cached_property
    def halves(self) -> dict[int, ObservedFrame | None]:
        """The frames to fit to at half the size."""
        return {row: None if frame is None else frame.shrunk(2) for row, frame in self.used.items()}


def fit_capture(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    report: ReportProgress,
    keypoints: Keypoints | None = None,
    effort: FitEffort = FitEffort(),
    known: Known = Known(),
) -> CaptureFit:
    """Return the fit of ``body`` to the silhouettes of a capture's training views.

    With given poses: first the shape; then rotations that are the same in all frames, and then
    those of every frame, each where it explains views clearly better that were left out. Without:
    poses are found first (``first_poses``). Raises DyngsError: no silhouettes, or nobody in them.
    """
    if not capture.has_alpha:
        raise DyngsError(
            f"{capture.root}: the images have no silhouettes; add masks of the person (docs/human.md)"
        )
    capture = capture.replace(splits=numbered(capture.splits))
    views = capture.splits["train"]
    given = capture.body is not None
    motion = (
        _unposed(views, body.joints)
        if capture.body is None
        else captured_motion(capture.root, capture.body["train"], views, body.joints)
    )
    seen = look_at(capture, motion, options, effort, keypoints or {})
    surface = surface_of(body, RESOLUTION)
    joints = known.joints
    if joints is not None:
        seen = seen.with_positions(
            {row: joints[frame] for frame, row in motion.rows.items() if frame in joints}
        )
    if given:
        fitting = Fitting(motion.clip, surface, near_given(motion.clip))
        tried = _from_given(fitting, seen, known.learned, report, effort)
    else:
        tick = ticker("first poses", report, num_ticks(len(motion.clip), marked=bool(keypoints)))
        clip = first_poses(motion.clip.times, surface, seen.used.__getitem__, tick)
        motion = CapturedMotion(clip, motion.frames)
        fitting = Fitting(clip, surface, usual(clip))
        tried = _from_silhouettes(fitting, seen, known.learned, report, effort)
    lens = None
    if known.guessed_lens:
        fitting = replace(fitting, expected=usual(motion.clip))
        steps = effort.steps_for(motion.clip)
        tick = ticker("focal length", report, 5 * steps)
        refined, lens = fit_lens(
            fitting, tried[-1].learned, known.learned, seen.used.__getitem__, steps, tick
        )
        if lens.taken:
            tried = (*tried, measured("the focal length refined", refined, fitting, seen))
    first_gain = 0.0 if not given else GAIN if known.shape else GAIN_OF_SHAPE
    chosen = (
        tried[-1] if lens is not None and lens.taken else simplest_of_the_best(tried, first_gain)
    )
    return CaptureFit(
        body_fit(chosen.learned, len(body.joints)), motion, chosen, tried, seen.held_out, lens
    )


def simplest_of_the_best(tried: Sequence[TriedFit], first_gain: float = GAIN_OF_SHAPE) -> TriedFit:
    """Return the candidate after which none is clearly better: ``tried`` is ordered from simple to
    complex.

    ``first_gain`` is the gain of IoU for which the first one is left: given poses are touched for
    much only.
    """
    best = tried[0]
    for candidate in tried[1:]:
        wanted = first_gain if best is tried[0] else GAIN
        best = candidate if candidate.iou > best.iou + wanted else best
    return best


def split_views(
    views: Sequence[View], motion: CapturedMotion
) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
    """Return, per row of the clip, the indices of the views to fit to, and of those left out to
    judge by.

    One view of each frame is left out, another one in each frame, where a frame has at least five.
    """
    rows = motion.rows
    by_row: dict[int, list[int]] = {row: [] for row in range(len(motion.clip))}
    for i, view in enumerate(views):
        by_row[rows[-1 if view.frame is None else view.frame]].append(i)
    used: dict[int, list[int]] = {}
    left_out: dict[int, list[int]] = {}
    for row, own in by_row.items():
        apart = own[row % len(own)] if len(own) >= 5 else -1
        rest = [i for i in own if i != apart]
        step = max(1, -(-len(rest) // MOST_VIEWS))
        used[row] = rest[row % step :: step]
        left_out[row] = [apart] if apart >= 0 else []
    return used, left_out


def _unposed(views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """Return a clip of the views' frames that says nothing about poses, for a body with ``joints``
    (J, 3)."""
    times = {-1 if view.frame is None else view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    last = max(len(frames) - 1, 1)
    moments = [
        row / last if times[frame] is None else times[frame] for row, frame in enumerate(frames)
    ]
    zeros = joints.new_zeros(len(frames), len(joints), 3)
    clip = MotionClip(
        torch.tensor(moments, dtype=torch.float64, device="cpu"),
        zeros,
        zeros[:, 0],
        torch.ones_like(zeros[:, 0, 0]),
    )
    return CapturedMotion(clip, frames)


def look_at(
    capture: Capture,
    motion: CapturedMotion,
    options: DataConfig,
    effort: FitEffort,
    keypoints: Keypoints,
) -> Seen:
    """Return the squares around the person in all frames. Raises DyngsError: nobody is seen."""
    views = capture.splits["train"]
    images = ImageLoader(
        views, options.model_copy(update={"longest_side": IMAGE_SIDE, "downscale": 1})
    )
    used, left_out = split_views(views, motion)
    shown = [i for rows in (used, left_out) for own in rows.values() for i in own]
    if float(np.mean([_border_covered(images[i]) for i in shown])) > MOST_OF_THE_BORDER:
        raise DyngsError(
            f"{capture.root}: the silhouettes cover the borders of the images; white is the person: are the masks "
            "inverted? (docs/human.md)"
        )
    side = longest_box_side(images[i] for i in shown)
    if side < 8:
        raise DyngsError(
            f"{capture.root}: nobody is seen in the silhouettes; check the masks (docs/human.md)"
        )
    size = min(effort.side, 2 * (side // 2))
    marked = _marked(views, images, shown, keypoints)

    def frames(rows: dict[int, list[int]]) -> dict[int, ObservedFrame | None]:
        return {
            row: observed_frame([images[i] for i in own], side, size, marked)
            for row, own in rows.items()
        }

    held_out = sum(map(len, left_out.values()))
    seen = frames(used)
    return Seen(seen, frames(left_out) if held_out else seen, held_out)


def _border_covered(image: Image) -> float:
    """Return the fraction of the image's outermost pixels that the silhouette covers."""
    if image.alpha is None:
        return 0.0
    inside = image.alpha > 0.5
    return float(
        torch.cat([inside[0], inside[-1], inside[1:-1, 0], inside[1:-1, -1]]).float().mean()
    )


def _marked(
    views: Sequence[View], images: ImageLoader, shown: Sequence[int], points: Keypoints
) -> Keypoints:
    """Return the key points (55, 3) in the pixels of the images, of those of the stored images."""
    found: Keypoints = {}
    for i in shown if points else ():
        view = views[i]
        if view.name in points:
            camera = images[i].cameras
            scale = points[view.name].new_tensor(
                [camera.width / view.width, camera.height / view.height, 1.0]
            )
            found[view.name] = points[view.name] * scale
    return found


def _from_given(
    fitting: Fitting, seen: Seen, shared: tuple[str, ...], report: ReportProgress, effort: FitEffort
) -> tuple[TriedFit, ...]:
    start = new_fit(fitting.clip, fitting.surface)
    tick = ticker("shape", report, 3 * effort.steps)
    half = InTurn(seen.halves)
    full = seen.used.__getitem__
    # Clothes and hair are no sign of wrong poses.
    dressed = fitting.run(start, ("padding",), effort.steps, half, tick)
    tried = [measured("the poses as given", dressed, fitting, seen)]
    shape = start
    for look in (half, full):
        shape = fitting.run(shape, shared, effort.steps, look, tick)
    tried.append(measured("one shape", shape, fitting, seen))
    more = (
        ("turns that are the same in all frames as well", (*shared, "turns"), effort.steps),
        (
            "turns of every frame as well",
            (*shared, "turns", "poses", "trans"),
            effort.steps_for(fitting.clip),
        ),
    )
    for name, learned, steps in more:
        few = -(-steps // TRIAL)
        tick = ticker("poses", report, few)
        found = fitting.run(tried[-1].learned, learned, few, full, tick, fallen=1 - 1 / TRIAL)
        candidate = measured(name, found, fitting, seen)
        if candidate.iou > max(x.iou for x in tried) + PROMISING * GAIN:
            found = fitting.run(found, learned, steps, full, ticker("poses", report, steps))
            candidate = max(candidate, measured(name, found, fitting, seen), key=lambda x: x.iou)
        tried.append(candidate)
    return tuple(tried)


def _from_silhouettes(
    fitting: Fitting, seen: Seen, shape: tuple[str, ...], report: ReportProgress, effort: FitEffort
) -> tuple[TriedFit, ...]:
    start = new_fit(fitting.clip, fitting.surface)
    steps = LONGER * effort.steps_for(fitting.clip)
    tick = ticker("shape", report, 2 * steps)
    found = start
    first = measured("poses found frame by frame", start, fitting, seen)
    for look in (seen.halves.__getitem__, seen.used.__getitem__):
        found = fitting.run(found, (*shape, "poses", "trans"), steps, look, tick, fallen=-HIGHER)
    return first, measured("one shape, and poses of every frame", found, fitting, seen)


def ticker(name: str, report: ReportProgress, total: int) -> Callable[[], None]:
    """Return a function that reports one more step of ``total``."""
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        report(name, done, total)

    return tick


@torch.no_grad()
def measured(name: str, learned: Parameters, fitting: Fitting, seen: Seen) -> TriedFit:
    """Return the candidate with its IoU in the frames that judge."""
    found = []
    for row, frame in seen.judged.items():
        found.append(torch.zeros(0, device="cpu"))
        if frame is not None:
            drawn = drawn_frame(learned, fitting.clip, fitting.surface, row, frame.cameras)
            ours = drawn > 0.5
            theirs = frame.alpha > 0.5
            known = frame.known > 0
            both = ours & theirs & known
            either = (ours | theirs) & known
            found[-1] = both.sum((1, 2)) / either.sum((1, 2)).clamp_min(1)
    per_frame = tuple(float(x.mean()) if len(x) else float("nan") for x in found)
    return TriedFit(name, learned, float(torch.cat(found).mean()), per_frame)


_CLEARLY = 0.001  # gain of IoU for which the clip is moved


@dataclass(frozen=True)
class NewClip:
    """Another clip of a fitted person."""

    motion: CapturedMotion  # its poses as given
    # (3,) to add to its translations, in the unit of the world, in place of that of the fit
    shift: Tensor
    iou: float  # with the shift of the fit
    iou_moved: float | None  # with that of the clip itself; None where that was not taken

    def summary(self) -> str:
        """Return a line for people."""
        if self.iou_moved is None:
            return f"new poses: at the place of the fit; overlap of silhouettes {self.iou:.3f}"
        return (
            f"new poses: moved to their silhouettes; overlap {self.iou:.3f} -> {self.iou_moved:.3f}"
        )


def placed_clip(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    found: CaptureFit,
    report: ReportProgress,
    effort: FitEffort = FitEffort(),
) -> NewClip | None:
    """Return the clip of ``pose`` moved to its silhouettes, if it looks better there; None without
    such a clip.

    All views of ``capture`` have frame numbers; ``found`` is the fit of those of training.
    """
    views = capture.splits.get("pose", ())
    if not views or capture.body is None:
        return None
    motion = captured_motion(capture.root, capture.body["pose"], views, body.joints)
    surface = surface_of(body, RESOLUTION)
    seen = look_at(capture.replace(splits={"train": views}), motion, options, effort, {})
    start = new_fit(motion.clip, surface)
    with torch.no_grad():
        for name, value in found.chosen.learned.values().items():
            if name not in ("poses", "trans"):
                start[name].copy_(value)
    name = "place of new poses"
    steps = min(effort.steps, PLACING)
    tick = ticker(name, report, steps)
    fitting = Fitting(motion.clip, surface, near_given(motion.clip))
    moved = fitting.run(start, ("shift",), steps, seen.used.__getitem__, tick)
    before, after = (measured(name, x, fitting, seen) for x in (start, moved))
    better = after.iou > before.iou + _CLEARLY
    shift = (moved if better else start)["shift"].detach()
    return NewClip(motion, shift, before.iou, after.iou if better else None)


def fitted_clips(
    capture: Capture, body: BodyTemplate, found: CaptureFit, new_poses: NewClip | None
) -> dict[Split, CapturedMotion]:
    """Return the clip of training, with the frames of val and test, and that of ``pose``, if the
    capture has one.

    Frames that were not fitted have what holds for all frames applied to their given poses; without
    given poses they lie between their neighbours. All views of ``capture`` have frame numbers;
    ``new_poses`` is the clip of ``pose``.
    """
    clips: dict[Split, CapturedMotion] = {"train": _of_training(capture, body, found)}
    if new_poses is not None:
        fit = replace(found.fit, shift=new_poses.shift)
        clips["pose"] = CapturedMotion(
            fit.applied(_expanded(new_poses.motion)), new_poses.motion.frames
        )
    return clips


def _of_training(capture: Capture, body: BodyTemplate, found: CaptureFit) -> CapturedMotion:
    fitted = replace(found.motion, clip=found.fit.fitted(found.motion.clip))
    known = _expanded(fitted)
    rows = fitted.rows
    views = [view for split in ("train", "val", "test") for view in capture.splits.get(split, ())]
    times = {-1 if view.frame is None else view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    if capture.body is not None:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
        others = found.fit.applied(motion.clip)
        at = motion.rows
        parts = [
            known.select(_row(rows[f])) if f in rows else others.select(_row(at[f])) for f in frames
        ]
    else:
        parts = [
            known.select(_row(rows[f])) if f in rows else fitted.clip.at(times[f]) for f in frames
        ]
    tensors = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("times", "poses", "trans", "scale")
    }
    return CapturedMotion(MotionClip(**tensors), frames)


def _expanded(motion: CapturedMotion) -> MotionClip:
    """Return a clip with a row for every frame, also of who never moves."""
    rows = motion.rows
    return motion.clip.select(torch.tensor([rows[frame] for frame in motion.frames], device="cpu"))


def _row(row: int) -> torch.Tensor:
    return torch.tensor([row], device="cpu")
