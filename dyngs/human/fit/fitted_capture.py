"""``dyngs data fit``: a capture of a person with the body fitted to it, and a report of the fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.conventions import ReportProgress
from dyngs.data.capture import Capture, Split
from dyngs.data.fitted_body import numbered
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import ImageLoader
from dyngs.files.outputs import require_new_folder
from dyngs.files.temporary import temporary_folder_beside
from dyngs.files.write import write_image, write_text
from dyngs.human.avatar.posing import frame_pose
from dyngs.human.fit.capture_fit import CaptureFit, Known, fit_capture
from dyngs.human.fit.clips import FittedClip, fitted_clips
from dyngs.human.fit.inputs import (
    NOTHING_ELSE,
    FitInputs,
    KnownAvatar,
    has_guessed_lens,
    joints_of,
    read_person,
    with_lens,
)
from dyngs.human.fit.keypoints import read_keypoints
from dyngs.human.fit.known_avatar import AvatarPoses, posed_by_avatar
from dyngs.human.fit.known_person import known_shape, shape_of, with_shape
from dyngs.human.fit.new_clip import NewClip, placed_clip
from dyngs.human.fit.overlays import FITTED, GIVEN, overlay, side_by_side
from dyngs.human.fit.surface import surface_of
from dyngs.human.fit.written import write_body, write_split
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.joints import JOINT_NAMES
from dyngs.human.template.load import default_template

REPORT_NAME, OVERLAYS_NAME = "fit_report.json", "fit_overlays.png"
_MASKS = ".masks"
_SHOWN, _COLUMNS, _SHOWN_SIDE, _SHOWN_RESOLUTION = 8, 4, 400, 72
"""Overlays, how many in a row, their longest side in pixels, and the texels per side of the body drawn over them."""


@dataclass(frozen=True)
class FittedCapture:
    """Result of ``write_fitted_capture``: the new capture's folder, the fit, and the clips that an avatar posed."""

    root: Path
    found: CaptureFit
    new_poses: NewClip | None = None
    by_avatar: tuple[AvatarPoses, ...] = ()

    def summary(self) -> str:
        """Return lines for people: how good the fit is."""
        found, frames = self.found, len(self.found.motion.clip)
        where = f"{found.held_out} views left out of the fit" if found.held_out else "the views fitted to"
        worst = int(np.nanargmin(found.chosen.per_frame))
        tried = ", ".join(f"{candidate.iou:.3f} with {candidate.name}" for candidate in found.tried)
        lens = "" if found.lens is None else f"\n{found.lens.summary()}"
        others = [x.summary() for x in (self.new_poses, *self.by_avatar) if x is not None]
        return (
            f"{frames} frames; overlap of silhouettes (IoU) on {where}: {tried}\n"
            f"taken: {found.chosen.name}; worst frame {found.motion.frames[worst]} with "
            f"{found.chosen.per_frame[worst]:.3f}; look at {self.root / OVERLAYS_NAME}{lens}"
            + "".join(f"\n{line}" for line in others)
        )


def write_fitted_capture(
    options: DataConfig, out: Path, report: ReportProgress, given: FitInputs = NOTHING_ELSE
) -> FittedCapture:
    """Fit the free template to a capture and write it to the new folder ``out`` in the layout ``body_json``.

    Files: ``transforms_SPLIT.json``, ``images/``, ``body_train.npz``, ``body_pose.npz`` for another clip whose poses
    were given by the same means, ``fit_report.json``, and ``fit_overlays.png`` to look at. ``given`` is what is
    known beside the capture, which may be a plain clip as well: see ``read_person``.

    Raises:
        DyngsError: see ``fit_capture``; ``out`` is not empty.
    """
    return _fitted(options, out, report, given, with_images=True)


def write_fit(options: DataConfig, out: Path, report: ReportProgress, given: FitInputs = NOTHING_ELSE) -> FittedCapture:
    """As ``write_fitted_capture``, but without images and cameras: for ``data.body``."""
    return _fitted(options, out, report, given, with_images=False)


def _fitted(
    options: DataConfig, out: Path, report: ReportProgress, given: FitInputs, *, with_images: bool
) -> FittedCapture:
    require_new_folder(out)
    person = None if given.person is None else known_shape(given.person)
    body, folder = default_template(), temporary_folder_beside(out)
    masks = folder / _MASKS
    try:
        capture = read_person(options, given, masks)
        capture = capture.replace(splits=numbered(capture.splits))
        points = {} if given.keypoints is None else read_keypoints(given.keypoints, capture.splits["train"])
        known = Known(joints_of(capture, given), has_guessed_lens(capture), person is not None)
        shaped = body if person is None else with_shape(body, person)
        found = fit_capture(capture, options, shaped, report, points, known=known)
        if person is not None:
            found = replace(found, fit=replace(found.fit, betas=shape_of(body, person)))
        capture = with_lens(capture, found.lens)
        new_poses = placed_clip(capture, options, shaped, found, report)
        clips = fitted_clips(capture, shaped, found, new_poses)
        by_avatar = () if given.avatar is None else _posed(given.avatar, capture, options, clips)
        if with_images:
            _write_images(folder, capture, options, clips)
            for split, clip in clips.items():
                clips[split] = replace(clip, frames=tuple(range(len(clip.frames))))
        _write_bodies(folder, capture, clips, found.fit.betas)
        write_image(folder / OVERLAYS_NAME, _overlays(capture, options, body, found))
        write_text(folder / REPORT_NAME, json.dumps(_report(found, new_poses, by_avatar), indent=1) + "\n")
        shutil.rmtree(masks, ignore_errors=True)
        folder.replace(out)  # also where ``out`` is an empty folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return FittedCapture(out, found, new_poses, by_avatar)


def _posed(
    avatar: KnownAvatar, capture: Capture, options: DataConfig, clips: dict[Split, FittedClip]
) -> tuple[AvatarPoses, ...]:
    """Give the clips the poses in which the avatar has their silhouettes; return what came out, clip by clip."""
    found: list[AvatarPoses] = []
    for split, clip in clips.items():
        found.append(posed_by_avatar(avatar, capture.splits[split], options, clip))
        clips[split] = found[-1].clip
    return tuple(found)


def _write_bodies(out: Path, capture: Capture, clips: Mapping[Split, FittedClip], betas: Tensor) -> None:
    """Write the clips, rows named by their frame numbers."""
    for split, found in clips.items():
        path = out / f"body_{split}.npz"
        write_body(path, found.clip, betas.numpy(), capture.world_offset, found.frames, capture.fps)


def _write_images(out: Path, capture: Capture, options: DataConfig, clips: Mapping[Split, FittedClip]) -> None:
    """Write the images and cameras of all splits."""
    full = options.model_copy(update={"longest_side": None, "downscale": 1, "body": None})
    for split, views in capture.splits.items():
        if views:
            images, found = ImageLoader(views, full), clips["pose" if split == "pose" else "train"]
            shown = ((view, images[i]) for i, view in enumerate(views))
            write_split(out, split, shown, found.rows, capture.world_offset)


def _overlays(capture: Capture, options: DataConfig, body: BodyTemplate, found: CaptureFit) -> np.ndarray:
    """Return images of the training views with the body's outline as given (red) and as fitted (green)."""
    views = capture.splits["train"]
    images = ImageLoader(views, options.model_copy(update={"longest_side": _SHOWN_SIDE, "downscale": 1}))
    given, fitted, rows = found.motion.clip, found.fit.fitted(found.motion.clip), found.motion.rows
    surface, sheets = surface_of(body, _SHOWN_RESOLUTION), []
    for i in evenly_spaced(len(views), _SHOWN):
        row = rows[-1 if views[i].frame is None else views[i].frame or 0]
        mean = torch.zeros_like(found.fit.betas)
        before, after = frame_pose(given, row), frame_pose(fitted, row)
        sheets.append(overlay(images[i], surface, [(mean, before, GIVEN), (found.fit.betas, after, FITTED)]))
    return side_by_side(sheets, _COLUMNS)


def _report(found: CaptureFit, new_poses: NewClip | None, by_avatar: tuple[AvatarPoses, ...]) -> dict[str, object]:
    """Return the report as JSON values."""
    fit, chosen = found.fit, found.chosen
    turns = np.degrees(fit.shared.turns.norm(dim=1).double().numpy())
    lens: dict[str, object] = {} if found.lens is None else {"lens": {**vars(found.lens)}}
    return lens | {
        "frames": len(found.motion.clip),
        "taken": chosen.name,
        "iou": {candidate.name: round(candidate.iou, 4) for candidate in found.tried},
        "views_left_out": found.held_out,
        "new_poses": None if new_poses is None else {"iou": new_poses.iou, "iou_moved": new_poses.iou_moved},
        "by_avatar": [
            {"iou": x.before, "iou_posed": x.after, "views_left_out": x.left_out, "taken": x.taken} for x in by_avatar
        ],
        "iou_per_frame": {
            str(frame): round(iou, 4)
            for frame, iou in zip(found.motion.frames, chosen.per_frame, strict=False)
            if iou == iou
        },
        "scale": float(np.exp(fit.shared.log_scale)),
        "betas": [round(beta, 4) for beta in fit.betas.tolist()],
        "turns_degrees": {name: round(float(turn), 2) for name, turn in zip(JOINT_NAMES, turns, strict=True) if turn},
    }
