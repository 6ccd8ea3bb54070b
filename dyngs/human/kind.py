"""The model kind ``human``: an animatable avatar of one person."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError, quote_path
from dyngs.human.keys import NO_BODY, HumanModel
from dyngs.models.kind import HasBody, HasGaussians, PlayedMotion

if TYPE_CHECKING:
    from pathlib import Path

    from dyngs.config import DataConfig
    from dyngs.data.capture import Capture
    from dyngs.human.avatar.scene import HumanScene
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

    def copy_pictures(self, data: DataConfig, folder: Path) -> None:
        for source in (data.root, data.body):
            for name in ("people.png", "detection.png", "fit_overlays.png"):
                # A capture from elsewhere may link to other files.
                if source is None or (source / name).is_symlink():
                    continue
                if (source / name).is_file():
                    folder.mkdir(exist_ok=True)
                    # Without permissions: captures may be read-only.
                    shutil.copyfile(source / name, folder / name)

    def write_avatar_picture(self, scene: HumanScene, folder: Path) -> Path:
        from dyngs.human.avatar.picture import avatar_picture
        from dyngs.io.write import write_image

        path = folder / "avatar.png"
        write_image(path, avatar_picture(scene))
        return path

    def play_motion(
        self, section: HumanModel, scene: Posable, info: CheckpointInfo, path: Path
    ) -> PlayedMotion:
        from dyngs.human.avatar.scene import HumanScene
        from dyngs.human.body.body_reader import load_template
        from dyngs.human.motion.motion import motion_clip
        from dyngs.human.motion.placement import place_like
        from dyngs.human.motion.retarget import read_motion

        if not isinstance(scene, HumanScene):
            raise DyngsError(f"{path}: motions can only be played by avatars (model.kind=human)")
        avatar = scene.to("cpu")
        joints = avatar.skeleton.joints
        motion = read_motion(path, load_template(section)).for_joints(len(joints))
        if bool((motion.scale != 1).any()):  # fitted to images, in the place of the person
            trans = motion.trans - motion.trans.new_tensor(info.world_offset)
            unit = info.world_scale
            clip = motion_clip(replace(motion, trans=trans / unit, scale=motion.scale / unit))
        else:
            clip = place_like(motion_clip(motion), avatar.clip, joints, avatar.skeleton.parents)
        return PlayedMotion(avatar.with_motion(clip).to(scene.device), motion.fps, motion.notes)

    def read_person(self, path: Path) -> tuple[HumanModel, Posable, CheckpointInfo]:
        from dyngs.human.avatar.avatar_file import read_avatar

        return read_avatar(path)

    def functions(self) -> tuple[Start, Restore]:
        from dyngs.human.avatar.start import restore, start

        return start, restore


HUMAN = HumanKind(HumanModel)
