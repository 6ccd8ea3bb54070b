"""The fitted poses of all frames that a capture shows, those of the fit and others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.conventions import ReportProgress
from dyngs.data.capture import Capture, Split
from dyngs.human.fit.capture_fit import RESOLUTION, CaptureFit, FitEffort, look_at, measured, ticker
from dyngs.human.fit.silhouettes import surface_of
from dyngs.human.fit.solve import Fitting, near_given, new_fit
from dyngs.human.motion.clip import CapturedMotion, MotionClip, captured_motion
from dyngs.human.template.body import BodyTemplate

_CLEARLY = 0.001  # gain of IoU for which the clip is moved
_EFFORT = FitEffort()


@dataclass(frozen=True)
class NewClip:
    """Another clip of a fitted person."""

    motion: CapturedMotion  # its poses as given
    shift: Tensor  # (3,) to add to its translations, in the unit of the world, in place of that of the fit
    iou: float  # with the shift of the fit
    iou_moved: float | None  # with that of the clip itself; None where that was not taken

    def summary(self) -> str:
        """Return a line for people."""
        if self.iou_moved is None:
            return f"new poses: at the place of the fit; overlap of silhouettes {self.iou:.3f}"
        return f"new poses: moved to their silhouettes; overlap {self.iou:.3f} -> {self.iou_moved:.3f}"


def placed_clip(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    found: CaptureFit,
    report: ReportProgress,
    effort: FitEffort = _EFFORT,
) -> NewClip | None:
    """Return the clip of ``pose`` moved to its silhouettes, if it looks better there; None without such a clip.

    All views of ``capture`` have frame numbers; ``found`` is the fit of those of training.
    """
    views = capture.splits.get("pose", ())
    if not views or capture.body is None:
        return None
    motion = captured_motion(capture.root, capture.body["pose"], views, body.joints)
    surface, seen = (
        surface_of(body, RESOLUTION),
        look_at(capture.replace(splits={"train": views}), motion, options, effort, {}),
    )
    start = new_fit(motion.clip, surface)
    with torch.no_grad():
        for name, value in found.chosen.learned.values().items():
            if name not in ("poses", "trans"):
                start[name].copy_(value)
    name, tick = "place of new poses", ticker("place of new poses", report, effort.steps)
    fitting = Fitting(motion.clip, surface, near_given(motion.clip))
    moved = fitting.run(start, ("shift",), effort.steps, seen.used.__getitem__, tick)
    before, after = (measured(name, x, fitting, seen) for x in (start, moved))
    better = after.iou > before.iou + _CLEARLY
    shift = (moved if better else start)["shift"].detach()
    return NewClip(motion, shift, before.iou, after.iou if better else None)


def fitted_clips(
    capture: Capture, body: BodyTemplate, found: CaptureFit, new_poses: NewClip | None
) -> dict[Split, CapturedMotion]:
    """Return the clip of training, with the frames of val and test, and that of ``pose``, if the capture has one.

    Frames that were not fitted have what holds for all frames applied to their given poses; without given poses they
    lie between their neighbours. All views of ``capture`` have frame numbers; ``new_poses`` is the clip of ``pose``.
    """
    clips: dict[Split, CapturedMotion] = {"train": _of_training(capture, body, found)}
    if new_poses is not None:
        fit = replace(found.fit, shift=new_poses.shift)
        clips["pose"] = CapturedMotion(fit.applied(_expanded(new_poses.motion)), new_poses.motion.frames)
    return clips


def _of_training(capture: Capture, body: BodyTemplate, found: CaptureFit) -> CapturedMotion:
    fitted = replace(found.motion, clip=found.fit.fitted(found.motion.clip))
    known, rows = _expanded(fitted), fitted.rows
    views = [view for split in ("train", "val", "test") for view in capture.splits.get(split, ())]
    times = {-1 if view.frame is None else view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    if capture.body is not None:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
        others, at = found.fit.applied(motion.clip), motion.rows
        parts = [known.select(_row(rows[f])) if f in rows else others.select(_row(at[f])) for f in frames]
    else:
        parts = [known.select(_row(rows[f])) if f in rows else fitted.clip.at(times[f]) for f in frames]
    tensors = {
        name: torch.cat([getattr(part, name) for part in parts]) for name in ("times", "poses", "trans", "scale")
    }
    return CapturedMotion(MotionClip(**tensors), frames)


def _expanded(motion: CapturedMotion) -> MotionClip:
    """Return a clip with a row for every frame, also of who never moves."""
    rows = motion.rows
    return motion.clip.select(torch.tensor([rows[frame] for frame in motion.frames], device="cpu"))


def _row(row: int) -> torch.Tensor:
    return torch.tensor([row], device="cpu")
