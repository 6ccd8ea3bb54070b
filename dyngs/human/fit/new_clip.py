"""The place of another clip of a person whose body was fitted before: the split ``pose`` of a capture.

Fits of two clips by the same means often differ by a centimetre in where the body stands, which nothing in the first
clip shows. Three numbers for the whole clip hardly follow noise; poses stay as they were given.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.conventions import ReportProgress
from dyngs.data.capture import Capture
from dyngs.human.fit.capture_fit import FRAMES, RESOLUTION, CaptureFit, FitEffort, look_at, measured, ticker
from dyngs.human.fit.pose_prior import near_given
from dyngs.human.fit.solve import Stage, new_fit, run_stage
from dyngs.human.fit.surface import surface_of
from dyngs.human.motion.captured import CapturedMotion, captured_motion
from dyngs.human.template.body import BodyTemplate

_CLEARLY = 0.001
"""Gain of IoU for which the clip is moved."""


_EFFORT = FitEffort()


@dataclass(frozen=True)
class NewClip:
    """Another clip of a fitted person.

    Attributes:
        motion: its poses as given.
        shift: (3,) to add to its translations, in the unit of the world, in place of that of the fit.
        iou: with the shift of the fit.
        iou_moved: with that of the clip itself; None where that was not taken.
    """

    motion: CapturedMotion
    shift: Tensor
    iou: float
    iou_moved: float | None

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

    Args:
        capture: all views with frame numbers.
        options: how its images are read.
        body: the template.
        found: the fit of the views of training.
        report: of progress.
        effort: how much it may cost.
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
    stage = Stage(effort.steps, FRAMES, ("shift",))
    moved = run_stage(start, stage, motion.clip, surface, seen.used.__getitem__, near_given(motion.clip), tick)
    before, after = (measured(name, x, motion.clip, surface, seen) for x in (start, moved))
    better = after.iou > before.iou + _CLEARLY
    shift = (moved if better else start)["shift"].detach()
    return NewClip(motion, shift, before.iou, after.iou if better else None)
