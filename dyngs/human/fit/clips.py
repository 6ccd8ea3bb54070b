"""The fitted poses of all frames that a capture shows, those of the fit and others.

Local letters: F frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from dyngs.data.capture import Capture, Split
from dyngs.human.fit.capture_fit import CaptureFit
from dyngs.human.fit.new_clip import NewClip
from dyngs.human.motion.captured import CapturedMotion, captured_motion
from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.body import BodyTemplate


@dataclass(frozen=True)
class FittedClip:
    """Poses of F frames: one row of ``clip`` for each of the numbers ``frames``."""

    clip: MotionClip
    frames: tuple[int, ...]

    @property
    def rows(self) -> dict[int, int]:
        """The row of each frame."""
        return {frame: row for row, frame in enumerate(self.frames)}


def fitted_clips(
    capture: Capture, body: BodyTemplate, found: CaptureFit, new_poses: NewClip | None
) -> dict[Split, FittedClip]:
    """Return the clip of training, with the frames of val and test, and that of ``pose``, if the capture has one.

    Frames that were not fitted have what holds for all frames applied to their given poses; without given poses they
    lie between their neighbours.

    Args:
        capture: all views with frame numbers.
        body: the template.
        found: the fit of the views of training.
        new_poses: the clip of ``pose``, None without.
    """
    clips: dict[Split, FittedClip] = {"train": _of_training(capture, body, found)}
    if new_poses is not None:
        fit = replace(found.fit, shift=new_poses.shift)
        clips["pose"] = FittedClip(fit.applied(_expanded(new_poses.motion)), new_poses.motion.frames)
    return clips


def _of_training(capture: Capture, body: BodyTemplate, found: CaptureFit) -> FittedClip:
    """Return the clip of all frames in train, val and test."""
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
    return FittedClip(MotionClip(**tensors), frames)


def _expanded(motion: CapturedMotion) -> MotionClip:
    """Return a clip with a row for every frame, also of who never moves."""
    rows = motion.rows
    return motion.clip.select(torch.tensor([rows[frame] for frame in motion.frames], device="cpu"))


def _row(row: int) -> torch.Tensor:
    return torch.tensor([row], device="cpu")
