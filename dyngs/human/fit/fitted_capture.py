"""``dyngs data fit``: a capture of a person with the body fitted to it, and a report of the fit."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from dyngs.capture.fixed_camera import (
    FORMAT,
    is_plain_clip,
    read_fixed_camera,
    silhouettes_of,
)
from dyngs.capture.masks import with_background_masks
from dyngs.capture.sfm.photos import digest_of
from dyngs.config import DataConfig
from dyngs.config.io import load_config
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, counted, reading, show
from dyngs.data.body_frames import numbered, read_body_file
from dyngs.data.capture import BodyFrames, Capture, Split, View
from dyngs.data.geometry import opengl_from_cam
from dyngs.data.images.images import straight_uint8
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import is_capture, read_capture
from dyngs.data.times import evenly_spaced
from dyngs.human.avatar.pose_fit import SILHOUETTES, fitted_to_images
from dyngs.human.avatar.posing import BodyPose, frame_pose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body import NUM_FITTED, BodyTemplate
from dyngs.human.body.body_reader import has_same_shapes, load_template, read_body, rest_shape
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit.capture_fit import (
    CaptureFit,
    NewClip,
    Surface,
    drawn_silhouettes,
    fit_capture,
    fitted_clips,
    placed_clip,
    surface_of,
)
from dyngs.human.fit.keypoints import read_joints, read_keypoints
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import CapturedMotion, MotionClip
from dyngs.io.outputs import make_once, new_folder
from dyngs.io.write import atomic_file, cache_folder, write_image, write_text

_BODY, _CONFIG = "body_train.npz", "config.yaml"


def template_of_run(path: Path) -> HumanModel:
    """Return what names the template of an avatar's run, of anything else the free one."""
    model = load_config(path / _CONFIG).model if (path / _CONFIG).is_file() else None
    return (
        HumanModel(body=model.body, uv=model.uv) if isinstance(model, HumanModel) else HumanModel()
    )


def known_shape(path: Path, body: BodyTemplate) -> BodyFrames:
    """Return the body parameters of a person, of whom only the shape counts, which is one of
    ``body``.

    ``path`` is a capture or a folder that ``dyngs data fit`` wrote, or the run of an avatar trained
    on one. Raises DyngsError: none of these, or a shape of another template.
    """
    with reading(path, "give a capture that `dyngs data fit` wrote, or a run trained on it"):
        folder = path
        if (path / _CONFIG).is_file():
            data = load_config(path / _CONFIG).data
            folder = data.root if data.body is None else data.body
        if not (folder / _BODY).is_file():
            raise DyngsError(
                f"{path}: no fitted person there; give a capture that `dyngs data fit` wrote, or its run"
            )
        found = read_body_file(folder / _BODY)
    if not has_same_shapes(body, found):
        raise DyngsError(
            f"{folder / _BODY}: is of another template than {body.name}; name that of the person with --template, or "
            "fit that person with `dyngs data fit` first"
        )
    return found


def with_shape(body: BodyTemplate, known: BodyFrames | None) -> BodyTemplate:
    """Return the template that is fitted: its mean shape is that of a known person, and it has no
    expressions.

    Of a file of SMPL's family it has the first ``NUM_FITTED`` shape parameters.
    """
    vertices, joints = (body.vertices, body.joints) if known is None else rest_shape(body, known)
    shaped = replace(body, vertices=vertices, joints=joints)
    if body.name == "anny" or body.shape_dirs is None or body.joint_shape_dirs is None:
        return shaped
    dirs = body.shape_dirs[..., :NUM_FITTED]
    joint_dirs = body.joint_shape_dirs[..., :NUM_FITTED]
    without = replace(shaped, expression_dirs=None, joint_expression_dirs=None)
    return replace(without, shape_dirs=dirs, joint_shape_dirs=joint_dirs)


def shape_of(body: BodyTemplate, known: BodyFrames) -> torch.Tensor:
    """Return the known shape parameters (B,) of a template with B of them; 0 for those that are not
    known."""
    betas = torch.zeros(body.num_shapes, device="cpu")
    given = torch.from_numpy(known.betas[: len(betas)]).float()
    betas[: len(given)] = given
    return betas


LONGEST_SIDE = 320
"""Of the images whose silhouettes are looked at, px, at most; an avatar trained on smaller ones is
compared at that size, since its edges are those of its images."""
CHECKED = 3  # time steps, at most, at which a view is left out to see what the fit is worth
_FEWEST_VIEWS = 3  # of a time step, so that one of them can be left out


@dataclass(frozen=True)
class KnownAvatar:
    """The avatar of a person, and the longest side of the images it was trained on, px; None: as
    they are."""

    scene: HumanScene
    longest_side: int | None


@dataclass(frozen=True)
class AvatarPoses:
    """Poses that an avatar found."""

    clip: CapturedMotion  # of all frames; as it was where ``taken`` is false
    before: float  # overlap of silhouettes (IoU) at some time steps, of the avatar
    after: float
    # number of views, which were left out of the fit, that this was measured on; 0: on those fitted
    # to
    left_out: int

    @property
    def taken(self) -> bool:
        """Whether these poses are better than those before."""
        return self.after > self.before

    def summary(self) -> str:
        """Return a line for people."""
        where = (
            f"{counted(self.left_out, 'view')} left out of the fit"
            if self.left_out
            else "the views fitted to"
        )
        what = "taken" if self.taken else "not taken"
        return (
            f"poses by the silhouette of the person's avatar: {what}; overlap on {where} {self.before:.3f} -> "
            f"{self.after:.3f}"
        )


def posed_by_avatar(
    avatar: KnownAvatar, views: Sequence[View], options: DataConfig, start: CapturedMotion
) -> AvatarPoses:
    """Return the poses of a clip in which the avatar has the silhouettes of its images, where that
    is better.

    Frames of ``start`` without an image keep their poses.
    """
    times = start.clip.times.tolist()
    shown = [replace(x, time=times[start.rows[-1 if x.frame is None else x.frame]]) for x in views]
    side = min(
        LONGEST_SIDE, options.longest_side or LONGEST_SIDE, avatar.longest_side or LONGEST_SIDE
    )
    small = options.model_copy(update={"longest_side": side, "downscale": 1})
    left_out, others = _left_out(shown)
    tested = ImageLoader(left_out or others, small)
    images = ImageLoader(others, small)
    scene = avatar.scene.playing(start.clip)
    before = _overlap(scene, tested)
    after = _overlap(_fitted(scene, images), tested)
    clip = start.clip
    if after > before:
        found = _fitted(scene, ImageLoader(shown, small)).played
        clip = clip if found is None else _with_rows(clip, found)
    return AvatarPoses(replace(start, clip=clip), before, after, len(left_out))


def _fitted(player: HumanScene, images: ImageLoader) -> HumanScene:
    nothing = player.gaussians.means.new_zeros(3)
    return fitted_to_images(player, images, nothing, SILHOUETTES)[0]


def _left_out(views: Sequence[View]) -> tuple[list[View], list[View]]:
    """Return one view of each of some time steps, and the others of these time steps to fit to.

    Time steps with too few views lose none.
    """
    groups: dict[float | None, list[View]] = {}
    for view in views:
        groups.setdefault(view.time, []).append(view)
    enough = [group for group in groups.values() if len(group) >= _FEWEST_VIEWS]
    some = enough or list(groups.values())
    chosen = [some[i] for i in evenly_spaced(len(some), CHECKED)]
    apart = [group[-1] for group in chosen] if enough else []
    return apart, [view for group in chosen for view in group if view not in apart]


@torch.no_grad()
def _overlap(scene: HumanScene, images: ImageLoader) -> float:
    """Return the mean intersection over union of the silhouettes of the person and of images."""
    found = []
    for image in (images[i] for i in range(len(images))):
        drawn = scene.render(image.cameras, image.time, options=scene.options).alpha[0] > 0.5
        truth = drawn if image.alpha is None else image.alpha > 0.5
        found.append(float((drawn & truth).sum() / (drawn | truth).sum().clamp_min(1)))
    return fmean(found)


def _with_rows(clip: MotionClip, found: MotionClip) -> MotionClip:
    """Return the clip with the rows of ``found`` at the times that are in both."""
    rows = torch.searchsorted(clip.times, found.times).clamp_max(len(clip) - 1)

    def put(before: Tensor, after: Tensor) -> Tensor:
        return before.index_copy(0, rows, after.to(before))

    return MotionClip(
        clip.times,
        put(clip.poses, found.poses),
        put(clip.trans, found.trans),
        put(clip.scale, found.scale),
    )


_LOOKED_AT, _PRESENT = 128, 0.2
"""Longest side of the images in which somebody is looked for, and the least fraction of the usual
area that counts."""


@dataclass(frozen=True)
class FitInputs:
    """What is given next to the capture; everything may be None."""

    keypoints: Path | None = None  # folder or file of 2D key points
    masks: Path | None = None  # folder of masks, white = the person
    # image of the place without the person, or a folder of one for each camera
    background: Path | None = None
    joints: Path | None = None  # file or folder of 3D joints or posed vertices, see ``read_joints``
    body: Path | None = None  # body file whose vertices these are; None: the template
    person: Path | None = None  # capture or run of the same person, whose shape is kept
    # of the same person, if that run has one: its silhouette decides the poses in the end
    avatar: KnownAvatar | None = None
    template: HumanModel = field(default_factory=HumanModel)  # names the body file that is fitted


def read_person(
    options: DataConfig, given: FitInputs, work: Path, say: Callable[[str], None] = show
) -> Capture:
    """Return a capture with silhouettes: of a capture, or a video or a folder of images of one
    fixed camera.

    Masks of ``given`` take the place of those of the capture; without any they are made from the
    background, in the folder ``work``. Raises DyngsError: neither capture nor clip; no masks, and
    none that can be made.
    """
    source = options.root
    if options.format == "auto" and not is_capture(source) and is_plain_clip(source):
        capture = read_fixed_camera(options, given.masks)
        for line in capture.warnings:
            say(line)
    else:
        capture = read_capture(options)
        if given.masks is not None:
            splits: dict[Split, tuple[View, ...]] = {}
            for split, views in capture.splits.items():
                found = silhouettes_of(
                    given.masks, [f"{view.name}{view.image_path.suffix}" for view in views]
                )
                splits[split] = tuple(
                    replace(view, silhouette=own) for view, own in zip(views, found, strict=True)
                )
            capture = capture.replace(splits=splits, has_alpha=True)
    if given.background is not None or not capture.has_alpha:
        if capture.format == "neuman":
            raise DyngsError(
                f"{source}: no silhouettes, and the camera moves; add masks of the person"
            )
        capture = with_background_masks(capture, work, given.background, say)
    found_only = capture.format == FORMAT or given.masks is not None
    return _without_empty_frames(capture, options, say) if found_only else capture


def _without_empty_frames(
    capture: Capture, options: DataConfig, say: Callable[[str], None]
) -> Capture:
    views = capture.splits["train"]
    small = ImageLoader(
        views, options.model_copy(update={"longest_side": _LOOKED_AT, "downscale": 1})
    )
    areas = [
        0.0 if (alpha := small[i].alpha) is None else float(alpha.mean()) for i in range(len(views))
    ]
    usual = sorted(areas)[len(areas) * 3 // 4]
    kept = tuple(view for view, area in zip(views, areas, strict=True) if area > _PRESENT * usual)
    if not kept:
        raise DyngsError(f"{capture.root}: nobody is seen in the masks; white is the person")
    if len(kept) < len(views):
        gone = [view.name for view in views if view not in kept]
        say(f"{len(gone)} frames in which hardly anybody is seen are left out, first {gone[0]}")
    return capture.replace(splits={**capture.splits, "train": kept})


FRAME_RATE = 30.0  # frames per second of a clip whose capture does not say


def write_body(
    path: Path,
    found: CapturedMotion,
    body: BodyTemplate,
    betas: np.ndarray,
    capture: Capture,
) -> None:
    """Write the body parameters of a clip, also readable as a motion: rows are named by their frame
    numbers.

    They are in the coordinates of the files of ``capture``. ``betas`` (B,) are of the shape space
    of the template ``body``.
    """
    clip = found.clip
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            poses=clip.poses.reshape(len(clip), -1).cpu().numpy(),
            trans=capture.world_scale * clip.trans.double().cpu().numpy() + capture.world_offset,
            betas=betas.astype(np.float32),
            scale=capture.world_scale * clip.scale.cpu().numpy(),
            surface_model_type=body.name,
            fitted_to="" if body.name == "anny" else body.fingerprint,
            gender="neutral",
            up_axis="y",
            frames=np.asarray(found.frames, dtype=np.int64),
            mocap_frame_rate=np.float64(FRAME_RATE if capture.fps is None else capture.fps),
        )


def write_split(
    out: Path,
    split: Split,
    shown: Iterator[tuple[View, Image, Image]],
    rows: Mapping[int, int],
    capture: Capture,
) -> None:
    """Write ``transforms_SPLIT.json`` and the images of a split as PNG with straight alpha,
    undistorted.

    Where masks are files beside the images, they stay so (``silhouette_path``).

    Args:
        shown: views with their images, and with these as they are without such masks.
        rows: frame numbers to rows of the body parameters.
        capture: that the views are of.
    """
    frames: list[dict[str, object]] = []
    for view, image, photo in shown:
        row = rows[-1 if view.frame is None else view.frame]
        stem = f"{split}/f{row:04d}_c{view.camera_id:02d}_{len(frames):05d}.png"
        name = f"images/{stem}"
        mask = f"masks/{stem}"
        parts = [photo.rgb_premultiplied] + (
            [] if photo.alpha is None else [photo.alpha[..., None]]
        )
        write_image(out / name, straight_uint8(torch.cat(parts, dim=-1)).numpy())
        if view.silhouette is not None and image.alpha is not None:
            write_image(out / mask, straight_uint8(image.alpha[..., None]).numpy())
        camera = image.cameras
        intrinsics = camera.intrinsics[0].double().numpy()
        pose = opengl_from_cam(view.cam_from_world).copy()
        pose[:3, 3] = capture.world_scale * pose[:3, 3] + capture.world_offset
        entry: dict[str, object] = {"file_path": name, "frame": row, "camera": view.camera_id}
        entry |= {} if view.silhouette is None else {"silhouette_path": mask}
        entry |= {} if view.time is None else {"time": view.time}
        entry |= {
            "w": camera.width,
            "h": camera.height,
            "fl_x": intrinsics[0, 0],
            "fl_y": intrinsics[1, 1],
        }
        frames.append(
            entry
            | {"cx": intrinsics[0, 2], "cy": intrinsics[1, 2], "transform_matrix": pose.tolist()}
        )
    write_text(out / f"transforms_{split}.json", json.dumps({"frames": frames}, indent=1) + "\n")


GIVEN = (0.9, 0.1, 0.1)
FITTED = (0.0, 0.7, 0.1)  # colours of the outlines: red and green


@torch.no_grad()
def overlay(
    image: Image,
    surface: Surface,
    bodies: Sequence[tuple[Tensor, BodyPose, tuple[float, float, float]]],
) -> np.ndarray:
    """Return the image (H, W, 3) in [0, 1] over white with the outlines of bodies.

    ``bodies`` are shape parameters, pose and colour of each, drawn one over the other.
    """
    sheet = image.composite(torch.ones_like(image.rgb_premultiplied[0, 0])).clamp(0, 1).clone()
    for betas, pose, colour in bodies:
        discs = surface.in_shape(betas, torch.zeros_like(surface.weights[:, 0])).in_pose(pose)
        inside = drawn_silhouettes(discs, image.cameras)[0] > 0.5
        grown = torch.nn.functional.max_pool2d((~inside).float()[None, None], 3, 1, 1)[0, 0] > 0
        sheet[inside & grown] = sheet.new_tensor(colour)
    return sheet.cpu().numpy()


def side_by_side(sheets: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Return one image of several, white where they are smaller than the largest."""
    height, width = (max(sheet.shape[axis] for sheet in sheets) for axis in (0, 1))
    rows = -(-len(sheets) // columns)
    whole = np.ones((rows * height, min(columns, len(sheets)) * width, 3), np.float32)
    for i, sheet in enumerate(sheets):
        top = i // columns * height
        left = i % columns * width
        whole[top : top + sheet.shape[0], left : left + sheet.shape[1]] = sheet
    return whole


REPORT_NAME, OVERLAYS_NAME = "fit_report.json", "fit_overlays.png"
_MASKS = ".masks"
_SHOWN, _COLUMNS, _SHOWN_SIDE, _SHOWN_RESOLUTION = 8, 4, 400, 72
"""Overlays, how many in a row, their longest side in pixels, and the texels per side of the body
drawn over them."""


@dataclass(frozen=True)
class FittedCapture:
    """Result of ``write_fitted_capture``: the new capture's folder, the fit, and the clips that an
    avatar posed."""

    root: Path
    found: CaptureFit
    model: HumanModel = field(default_factory=HumanModel)  # names the template
    template: str = "anny"  # the same for people
    new_poses: NewClip | None = None
    by_avatar: tuple[AvatarPoses, ...] = ()

    def summary(self) -> str:
        """Return lines for people: how good the fit is."""
        found = self.found
        frames = len(self.found.motion.clip)
        where = (
            f"{counted(found.held_out, 'view')} left out of the fit"
            if found.held_out
            else "the views fitted to"
        )
        worst = int(np.nanargmin(found.chosen.per_frame))
        tried = ", ".join(f"{candidate.iou:.3f} with {candidate.name}" for candidate in found.tried)
        named = "" if self.template == "anny" else f"{self.template}, "
        others = [x.summary() for x in (self.new_poses, *self.by_avatar) if x is not None]
        return (
            f"{named}{counted(frames, 'frame')}; overlap of silhouettes (IoU) on {where}: {tried}\n"
            f"taken: {found.chosen.name}; worst frame {found.motion.frames[worst]} with "
            f"{found.chosen.per_frame[worst]:.3f}; look at {self.root / OVERLAYS_NAME}"
            + "".join(f"\n{line}" for line in others)
        )


def write_fitted_capture(
    options: DataConfig,
    out: Path,
    report: ReportProgress,
    given: FitInputs = FitInputs(),
    *,
    with_images: bool = True,
) -> FittedCapture:
    """Fit the template to a capture and write it to the new folder ``out`` in the layout
    ``body_json``.

    Files: ``transforms_SPLIT.json``, ``images/`` and found ``masks/`` (else for ``data.body``),
    ``body_train.npz``, ``body_pose.npz`` for another clip, ``fit_report.json``, and
    ``fit_overlays.png`` to look at. Raises DyngsError: see ``fit_capture``; ``out`` is not empty; a
    template that cannot be read or has no texture coordinates.
    """
    if given.person is not None and given.template.body is None:
        given = replace(given, template=template_of_run(given.person))
    body = load_template(given.template)
    _require_texels(given.template, body)
    name = _called(given.template, body)
    person = None if given.person is None else known_shape(given.person, body)
    with new_folder(out) as folder:
        masks = folder / _MASKS
        capture = read_person(options, given, masks)
        capture = capture.replace(splits=numbered(capture.splits))
        points = (
            {}
            if given.keypoints is None
            else read_keypoints(given.keypoints, capture.splits["train"])
        )
        joints = None
        if given.joints is not None:
            joints = read_joints(
                given.joints, capture, body if given.body is None else read_body(given.body)
            )
        first = _given_shape(capture, body) if person is None else person
        shaped = with_shape(body, first)
        found = fit_capture(
            capture,
            options,
            shaped,
            report,
            points,
            joints=joints,
            one_camera=capture.format == FORMAT,
            shape_known=person is not None,
        )
        betas = _added(found.fit.betas, None if first is None else shape_of(body, first))
        new_poses = placed_clip(capture, options, shaped, found, report)
        clips = fitted_clips(capture, shaped, found, new_poses)
        by_avatar: dict[Split, AvatarPoses] = {}
        if given.avatar is not None:
            by_avatar = {
                x: posed_by_avatar(given.avatar, capture.splits[x], options, clips[x])
                for x in clips
            }
        clips |= {split: found_by.clip for split, found_by in by_avatar.items()}
        if with_images:
            full = options.model_copy(update={"longest_side": None, "downscale": 1, "body": None})
            for split, views in capture.splits.items():
                if not views:
                    continue
                rows = clips.get(split, clips["train"]).rows
                photos = [replace(x, silhouette=None) for x in views]
                shown = zip(views, _in_order(views, full), _in_order(photos, full), strict=True)
                write_split(folder, split, shown, rows, capture)
            clips = {
                split: replace(clip, frames=tuple(range(len(clip.frames))))
                for split, clip in clips.items()
            }
        for split, clip in clips.items():
            path = folder / f"body_{split}.npz"
            write_body(path, clip, body, betas.numpy(), capture)
        write_image(folder / OVERLAYS_NAME, _overlays(capture, options, shaped, found))
        said = {"template": name, "betas": [round(beta, 4) for beta in betas.tolist()]}
        said |= _report(found, new_poses, tuple(by_avatar.values()))
        write_text(folder / REPORT_NAME, json.dumps(said, indent=1) + "\n")
        shutil.rmtree(masks, ignore_errors=True)
    return FittedCapture(out, found, given.template, name, new_poses, tuple(by_avatar.values()))


def _called(model: HumanModel, body: BodyTemplate) -> str:
    """Return the name of a template for people."""
    return body.name if model.body is None else f"{body.name} ({model.body.name})"


def _require_texels(model: HumanModel, body: BodyTemplate) -> None:
    """Raise DyngsError if the template has no texture coordinates."""
    if body.uv is None:
        raise DyngsError(
            f"{model.body}: has no texture coordinates, which the fit needs to draw the body; name the .obj that has "
            "them (--uv FILE, of a training model.uv=FILE)"
        )


def _given_shape(capture: Capture, body: BodyTemplate) -> BodyFrames | None:
    """Return the parameters of a capture with a shape of a template of SMPL's family, which the fit
    begins with."""
    given = None if capture.body is None else capture.body["train"]
    return (
        given
        if given is not None and body.name != "anny" and has_same_shapes(body, given)
        else None
    )


def _added(learned: Tensor, first: Tensor | None) -> Tensor:
    """Return shape parameters learned (B,), added to those of the shape that the fit began with (at
    least B)."""
    return (
        learned
        if first is None
        else first + torch.nn.functional.pad(learned, (0, len(first) - len(learned)))
    )


def _in_order(views: Sequence[View], options: DataConfig) -> Iterator[Image]:
    images = ImageLoader(views, options.model_copy(update={"cache_mb": 0}))
    return (images[i] for i in range(len(images)))


def _overlays(
    capture: Capture, options: DataConfig, body: BodyTemplate, found: CaptureFit
) -> np.ndarray:
    views = capture.splits["train"]
    images = ImageLoader(
        views, options.model_copy(update={"longest_side": _SHOWN_SIDE, "downscale": 1})
    )
    given = found.motion.clip
    fitted = found.fit.fitted(found.motion.clip)
    rows = found.motion.rows
    surface = surface_of(body, _SHOWN_RESOLUTION)
    sheets = []
    for i in evenly_spaced(len(views), _SHOWN):
        row = rows[-1 if views[i].frame is None else views[i].frame or 0]
        mean = torch.zeros_like(found.fit.betas)
        before = frame_pose(given, row)
        after = frame_pose(fitted, row)
        sheets.append(
            overlay(images[i], surface, [(mean, before, GIVEN), (found.fit.betas, after, FITTED)])
        )
    return side_by_side(sheets, _COLUMNS)


def _report(
    found: CaptureFit, new_poses: NewClip | None, by_avatar: Sequence[AvatarPoses]
) -> dict[str, object]:
    fit = found.fit
    chosen = found.chosen
    turns = np.degrees(fit.shared.turns.norm(dim=1).double().numpy())
    return {
        "frames": len(found.motion.clip),
        "taken": chosen.name,
        "iou": {candidate.name: round(candidate.iou, 4) for candidate in found.tried},
        "views_left_out": found.held_out,
        "new_poses": None
        if new_poses is None
        else {"iou": new_poses.iou, "iou_moved": new_poses.iou_moved},
        "by_avatar": [
            {"iou": x.before, "iou_posed": x.after, "views_left_out": x.left_out, "taken": x.taken}
            for x in by_avatar
        ],
        "iou_per_frame": {
            str(frame): round(iou, 4)
            for frame, iou in zip(found.motion.frames, chosen.per_frame, strict=False)
            if iou == iou
        },
        "scale": float(np.exp(fit.shared.log_scale)),
        "turns_degrees": {
            name: round(float(turn), 2)
            for name, turn in zip(JOINT_NAMES, turns, strict=False)
            if turn
        },
    }


# folder of a capture with key points of its images, as OpenPose writes them
KEYPOINTS = "keypoints"
_LARGEST = 100_000_000
"""Files of a capture larger than this many bytes, such as videos, are not what it says about bodies
and cameras."""


def with_fitted_body(
    data: DataConfig,
    model: HumanModel | None = None,
    *,
    only_if_needed: bool = False,
    say: Callable[[str], None] = show,
    report: ReportProgress = report_nothing,
) -> DataConfig:
    """Return the options with a fit of a template to the capture; the same capture is fitted once.

    ``model`` names the template; None: the free one. Nothing is fitted where ``data.body`` names a
    fit, where the capture holds one of this template, or without silhouettes; with
    ``only_if_needed`` where it has body parameters. Raises DyngsError: neither body parameters nor
    silhouettes, or a template that cannot be read.
    """
    model = model or HumanModel()
    if data.body is not None:
        path = data.body / "body_train.npz"
        if path.is_file() and not has_same_shapes(load_template(model), read_body_file(path)):
            say(
                f"body:    {data.body} is a fit of another template: its poses are taken, not its shape"
            )
        return data
    capture = read_capture(data)
    given = None if capture.body is None else capture.body["train"]
    if given is not None and only_if_needed:
        return data
    body = load_template(model)
    if given is not None and _is_fit_of(body, given):
        return data
    if not capture.has_alpha:
        if capture.body is None:
            raise DyngsError(
                f"{data.root}: has neither silhouettes nor body parameters, so no person can be found; add masks of "
                "the person (docs/person.md)"
            )
        say(f"{data.root}: no silhouettes, so the body parameters are taken as given")
        return data
    own, what = "", "fitted"
    if model.body is not None:
        _require_texels(model, body)
        own = f".{body.fingerprint}"
        what = f"{_called(model, body)} is fitted"
    folder = (
        cache_folder("bodies")
        / f"{re.sub(r'[^A-Za-z0-9-]', '_', data.root.name)[:40]}.{_digest(data)}{own}"
    )

    def fit() -> None:
        say(f"body:    {what} to the silhouettes first, as by `dyngs data fit`, into {folder}")
        points = data.root / KEYPOINTS
        inputs = FitInputs(points if points.is_dir() else None, template=model)
        say(write_fitted_capture(data, folder, report, inputs, with_images=False).summary())

    make_once(folder, fit, say, f"body:    the fit of before, in {folder}")
    return data.model_copy(update={"body": folder})


def _is_fit_of(body: BodyTemplate, given: BodyFrames) -> bool:
    """Return whether dyngs fitted ``body`` to get ``given``; of the free template nobody else has
    the shape space."""
    return (
        given.shape_space == "anny" if body.name == "anny" else given.fitted_to == body.fingerprint
    )


def _digest(data: DataConfig) -> str:
    """Return a digest of the capture's files (names, sizes, times of change) and of the options of
    reading it."""
    root = data.root.resolve()
    with reading(root):
        files = sorted(
            path for path in root.rglob("*") if path.is_file() and path.stat().st_size < _LARGEST
        )
    chosen_by = {"format", "frames", "pose_frames", "train_cameras", "times", "frames_per_second"}
    names = chosen_by | {"test_every", "skip_missing"}
    options = data.model_dump(mode="json", include=names)
    chosen = hashlib.sha256(repr(sorted(options.items())).encode()).hexdigest()[:8]
    return f"{digest_of(root, files)}{chosen}"
