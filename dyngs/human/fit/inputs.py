"""The inputs of ``dyngs data fit``: captures, plain clips of one fixed camera, masks made from the background."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.capture.background import with_background_masks
from dyngs.capture.fixed_camera import FORMAT, is_plain_clip, read_fixed_camera, silhouettes_of, zoomed
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.data.read import is_capture, read_capture
from dyngs.errors import DyngsError
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.fit.solve import LensFit

_LOOKED_AT, _PRESENT = 128, 0.2
"""Longest side of the images in which somebody is looked for, and the least fraction of the usual area that counts."""


@dataclass(frozen=True)
class KnownAvatar:
    """The avatar of a person, and the longest side of the images it was trained on, px; None: as they are."""

    scene: HumanScene
    longest_side: int | None


@dataclass(frozen=True)
class FitInputs:
    """What is given beside the capture; everything may be None."""

    keypoints: Path | None = None  # folder or file of 2D key points
    masks: Path | None = None  # folder of masks, white = the person
    background: Path | None = None  # image of the place without the person, or a folder of one for each camera
    joints: Path | None = None  # file or folder of 3D joints or posed vertices, see ``read_joints``
    body: Path | None = None  # body file whose vertices these are; None: the free template
    person: Path | None = None  # capture or run of the same person, whose shape is kept
    # of the same person, if that run has one: its silhouette decides the poses in the end
    avatar: KnownAvatar | None = None


NOTHING_ELSE = FitInputs()  # nothing beside the capture


def has_guessed_lens(capture: Capture) -> bool:
    """Whether the camera of a capture was guessed."""
    return capture.format == FORMAT


def read_person(options: DataConfig, given: FitInputs, work: Path, say: Callable[[str], None] = print) -> Capture:
    """Return a capture of a person with silhouettes.

    ``root`` of the options is a capture, or a video or a folder of images of one fixed camera. Masks of ``given`` take
    the place of those of the capture; without any the person is told from the background. Masks that are made are
    written to the folder ``work``. Raises DyngsError: neither capture nor clip; no masks, and none that can be made.
    """
    source = options.root
    if options.format == "auto" and not is_capture(source) and is_plain_clip(source):
        capture = read_fixed_camera(options, given.masks)
        for line in capture.warnings:
            say(line)
    else:
        capture = read_capture(options)
        capture = capture if given.masks is None else _with_masks(capture, given.masks)
    if given.background is not None or not capture.has_alpha:
        if capture.format == "neuman":
            raise DyngsError(f"{source}: no silhouettes, and the camera moves; add masks of the person")
        capture = with_background_masks(capture, work, given.background, say)
    return _without_empty_frames(capture, options, say) if has_guessed_lens(capture) else capture


def with_lens(capture: Capture, lens: LensFit | None) -> Capture:
    """Return the capture with the focal length that was found."""
    if lens is None or not lens.taken:
        return capture
    splits = {
        name: tuple(zoomed(view, lens.factor, lens.distance) for view in views)
        for name, views in capture.splits.items()
    }
    return capture.replace(splits=splits)


def _with_masks(capture: Capture, masks: Path) -> Capture:
    splits = {}
    for split, views in capture.splits.items():
        found = silhouettes_of(masks, [f"{view.name}{view.image_path.suffix}" for view in views])
        splits[split] = tuple(replace(view, silhouette=own) for view, own in zip(views, found, strict=True))
    return capture.replace(splits=splits, has_alpha=True)


def _without_empty_frames(capture: Capture, options: DataConfig, say: Callable[[str], None]) -> Capture:
    views = capture.splits["train"]
    small = ImageLoader(views, options.model_copy(update={"longest_side": _LOOKED_AT, "downscale": 1}))
    areas = []
    for i in range(len(views)):
        alpha = small[i].alpha
        areas.append(0.0 if alpha is None else float(alpha.mean()))
    usual = sorted(areas)[len(areas) * 3 // 4]
    kept = tuple(view for view, area in zip(views, areas, strict=True) if area > _PRESENT * usual)
    if not kept:
        raise DyngsError(f"{capture.root}: nobody is seen in the masks; white is the person")
    if len(kept) < len(views):
        gone = len(views) - len(kept)
        say(f"{gone} frames in which hardly anybody is seen are left out, first {_first(views, kept)}")
    return capture.replace(splits={"train": kept})


def _first(views: tuple[View, ...], kept: tuple[View, ...]) -> str:
    names = {view.name for view in kept}
    return next(view.name for view in views if view.name not in names)
