"""The model kind ``human``: an animatable avatar of one person."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError, quote_path
from dyngs.human.keys import NO_BODY, HumanModel
from dyngs.models.kind import HasBody, HasGaussians, PlayedMotion

if TYPE_CHECKING:
    from pathlib import Path

    from dyngs.config import DataConfig
    from dyngs.data.capture import Capture
    from dyngs.models.checkpoint import CheckpointInfo
    from dyngs.models.kind import Restore, Start
    from dyngs.models.renderable import Posable


class HumanKind(HasGaussians, HasBody):
    """Avatars; body poses are refined instead of camera poses."""

    uses = (HasGaussians.uses | {"data.person", "data.stature"}) - {
        "init",
        "camera.refine",
        "train.robust",
        "train.priors",
    }

    def refusal(self, capture: Capture) -> str | None:
        if capture.body is not None:
            return None
        return NO_BODY

    def find_body(
        self,
        data: DataConfig,
        section: HumanModel,
        log: Callable[[str], None],
        on_progress: ProgressCallback,
    ) -> DataConfig:
        """Detect the person in a plain clip, fit the body, and return options with both."""
        from dyngs.capture.sfm.unposed import is_unposed
        from dyngs.human.fit.fitted_capture import ensure_fitted_body

        if is_unposed(data):
            from dyngs.human.detect.detect_person import ensure_detected_person

            data = ensure_detected_person(data, log=log, on_progress=on_progress)
        elif data.person is not None:
            raise DyngsError(
                f"data.person={data.person}: only clips are searched for people during training; "
                f"run `dyngs data people {quote_path(data.root)} OUT --person {data.person}` first"
            )
        return ensure_fitted_body(
            data, section, only_if_needed=not section.fit, log=log, on_progress=on_progress
        )

    def play_motion(
        self, section: HumanModel, scene: Posable, info: CheckpointInfo, path: Path
    ) -> PlayedMotion:
        from dyngs.human.avatar.play_motion import play_motion

        return play_motion(section, scene, info, path)

    def read_person(self, path: Path) -> tuple[HumanModel, Posable, CheckpointInfo]:
        from dyngs.human.avatar.avatar_file import read_avatar

        return read_avatar(path)

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.human.avatar.start import restore, start

        return start, restore


HUMAN = HumanKind(HumanModel)
