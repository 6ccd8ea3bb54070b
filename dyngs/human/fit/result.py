"""A fitted body: its shape, and the correction of the poses it was given, for the fitted clip and for others.

Local letters: F frames, J joints, B shape parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.gaussians.parameters import Parameters
from dyngs.human.avatar.corrections import SharedCorrection, corrected_clip
from dyngs.human.motion.clip import MotionClip
from dyngs.human.pose.skinning import axis_angle_to_matrix


@dataclass(frozen=True)
class BodyFit:
    """A body fitted to a clip of F frames, as a correction of the poses that were given.

    Attributes:
        betas: (B,) shape parameters of the template.
        shared: turns of the joints and factor on the size, the same in all frames.
        offset: (3,) m, correction of the translation in the frame of the pelvis, the same in all frames.
        shift: (3,) the same in the frame of the world, in its unit.
        poses: (F, J, 3) axis-angle, rad, added to the turns per frame.
        trans: (F, 3) added to the given translations.
    """

    betas: Tensor
    shared: SharedCorrection
    offset: Tensor
    shift: Tensor
    poses: Tensor
    trans: Tensor

    def fitted(self, clip: MotionClip) -> MotionClip:
        """Return the clip that was fitted, with its corrections."""
        return self._moved(corrected_clip(self.shared, clip, self.poses, self.trans))

    def applied(self, clip: MotionClip) -> MotionClip:
        """Return another clip whose poses were given by the same means, with what holds for all frames."""
        return self._moved(corrected_clip(self.shared, clip))

    def _moved(self, turned: MotionClip) -> MotionClip:
        """Return the turned clip at its place."""
        roots = axis_angle_to_matrix(turned.poses[:, 0])
        away = self.shift + turned.scale[:, None] * (roots @ self.offset[:, None])[..., 0]
        return replace(turned, trans=turned.trans + away)


def body_fit(learned: Parameters, joints: int) -> BodyFit:
    """Return what was learned (``new_fit``) as a fit of a body of so many joints."""
    values = learned.values()

    def padded(turns: Tensor) -> Tensor:
        blank = turns.new_zeros(*turns.shape[:-2], joints - turns.shape[-2], 3)
        return torch.cat([turns, blank], dim=-2)

    shared = SharedCorrection(padded(values["turns"]), float(values["log_scale"][0]))
    places = (values["offset"], values["shift"])
    return BodyFit(values["betas"], shared, *places, padded(values["poses"]), values["trans"])
