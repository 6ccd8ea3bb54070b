"""``dyngs data fit``: fits the body to a capture and writes the fitted capture with a report."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from dyngs.capture.fixed_camera import (
    FORMAT,
    is_image_sequence,
    read_fixed_camera,
    silhouettes_of,
)
from dyngs.capture.masks import add_background_masks
from dyngs.capture.sfm.photos import digest_files
from dyngs.config import DataConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info, wrap_read_errors
from dyngs.data.body_frames import assign_frame_numbers, frame_number, read_body_file
from dyngs.data.capture import BodyFrames, Capture, Split, View, group_by_camera
from dyngs.data.geometry import camera_center, to_opengl_pose
from dyngs.data.images.images import to_straight_uint8
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import ImageLoader
from dyngs.data.read import is_capture, read_capture
from dyngs.data.times import evenly_spaced
from dyngs.human.avatar.pose_fit import SILHOUETTE_COMPARISON, fit_poses_to_images
from dyngs.human.avatar.posing import frame_pose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body import NUM_FITTED_SHAPES, BodyTemplate, apply_shape
from dyngs.human.body.body_reader import has_same_shape_space, load_template, rest_shape
from dyngs.human.fit.camera_refinement import refine_cameras
from dyngs.human.fit.capture_fit import (
    STATURE,
    CaptureFit,
    body_discs,
    collect_fitted_clips,
    fit_capture,
    place_new_poses,
    render_silhouettes,
)
from dyngs.human.fit.keypoints import (
    Joints3D,
    read_joints,
    read_keypoints,
    read_relative_joints,
)
from dyngs.human.fit.triangulation import orient_relative_joints, triangulate_joints
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import CapturedMotion
from dyngs.io.outputs import atomic_folder, make_once
from dyngs.io.write import atomic_file, cache_folder, write_image, write_text

_BODY = "body_train.npz"


@dataclass(frozen=True)
class KnownAvatar:
    """Trained avatar of the person, and the longest image side of its training, px (None: full
    size)."""

    scene: HumanScene
    longest_side: int | None


@dataclass(frozen=True)
class FitInputs:
    """Optional inputs of the body fit besides the capture."""

    keypoints: Path | None = None  # folder or file of 2D key points
    masks: Path | None = None  # folder of masks, white = the person
    joints: Path | None = None  # file or folder of 3D joints, see ``read_joints``
    person: Path | None = None  # fitted capture or run of the same person, whose shape is reused
    avatar: KnownAvatar | None = None  # of the same person; poses are refined by its silhouette
    template: HumanModel = field(default_factory=HumanModel)  # names the body file


@dataclass(frozen=True)
class FittedCapture:
    """Result of ``write_fitted_capture``: folder of the new capture, the fit, a text summary."""

    root: Path
    fit: CaptureFit
    model: HumanModel  # names the body file
    summary: str


def write_fitted_capture(
    options: DataConfig,
    out: Path,
    on_progress: ProgressCallback,
    inputs: FitInputs = FitInputs(),
    *,
    with_images: bool = True,
) -> FittedCapture:
    """Fit the template to a capture and write the fitted capture to the new folder ``out``.

    Files, in the layout ``body_json``: ``transforms_SPLIT.json``, ``images/``, ``masks/``
    (estimated masks), ``body_train.npz``, ``body_pose.npz`` for another clip, ``fit_report.json``
    and ``fit_overlays.png``. Without images the folder can be used as ``data.body``. Raises
    DyngsError: see ``fit_capture``; ``out`` is not empty; or a template that cannot be read or has
    no UV map.
    """
    model = inputs.template
    if inputs.person is not None and model.body is None:
        model = read_run_template(inputs.person)
    body = load_template(model)
    _require_texels(model, body)
    person = None if inputs.person is None else read_known_shape(inputs.person, body)
    with atomic_folder(out) as folder:
        masks = folder / ".masks"
        capture = read_person_capture(options, inputs, masks)
        capture = capture.replace(splits=assign_frame_numbers(capture.splits))
        views = capture.splits["train"]
        is_size_known = capture.body is not None or inputs.joints is not None
        centre = None if is_size_known else _fixed_camera_centre(views)
        if options.stature is not None and centre is None:
            raise _known_size_error(options)
        # The fit starts from the shape of a known person, or from that of the capture.
        known_body = person
        if known_body is None and body.name != "anny" and capture.body is not None:
            capture_body = capture.body["train"]
            known_body = capture_body if has_same_shape_space(body, capture_body) else None
        shaped = apply_known_shape(body, known_body)
        keypoints = None if inputs.keypoints is None else read_keypoints(inputs.keypoints, views)
        cameras = None
        if inputs.joints is not None:
            joints = read_joints(inputs.joints, capture)
        else:
            if capture.body is None:
                cameras = refine_cameras(views, keypoints or {})
            if cameras is not None:
                splits = {split: cameras.apply(x) for split, x in capture.splits.items()}
                capture = capture.replace(splits=splits)
                views = capture.splits["train"]
            joints = triangulate_joints(views, keypoints or {})
        relative: Joints3D = {}
        if inputs.keypoints is not None and keypoints is not None:
            in_camera = read_relative_joints(inputs.keypoints, views)
            relative = orient_relative_joints(views, keypoints, in_camera)
        fit = fit_capture(
            capture,
            options,
            shaped,
            on_progress,
            keypoints,
            joints=joints,
            relative_joints={frame: x for frame, x in relative.items() if frame not in joints},
            one_camera=centre is not None,
            shape_known=person is not None,
        )
        betas = known_betas(body, known_body)
        betas[: len(fit.betas)] += fit.betas
        new_poses = place_new_poses(capture, options, shaped, fit, on_progress)
        clips = collect_fitted_clips(capture, shaped, fit, new_poses)
        stature = options.stature or STATURE
        if centre is not None:
            height = _standing_height(shaped, fit)
            if person is not None and options.stature is None:
                stature = height * float(person.scale.mean())
            factor = stature / (height * float(fit.clip.scale.mean()) * capture.world_scale)
            for split, clip in clips.items():
                clips[split] = _enlarge(clip, factor, centre)
        by_avatar: list[AvatarPoseFit] = []
        if inputs.avatar is not None:
            for split, clip in clips.items():
                posed = fit_poses_by_avatar(inputs.avatar, capture.splits[split], options, clip)
                clips[split] = posed.clip
                by_avatar.append(posed)
        if with_images:
            windows = crop_windows(capture, options)
            for split in capture.splits:
                rows = clips.get(split, clips["train"]).rows
                write_split(folder, split, rows, capture, options, windows)
            clips = {
                split: replace(clip, frames=tuple(range(len(clip.frames))))
                for split, clip in clips.items()
            }
        for split, clip in clips.items():
            write_body_file(folder / f"body_{split}.npz", clip, body, betas.numpy(), capture)
        write_image(folder / "fit_overlays.png", _overlays(capture, options, shaped, fit))
        shutil.rmtree(masks, ignore_errors=True)
        chosen = fit.chosen
        fields = {
            "template": _template_label(model, body),
            "betas": [round(beta, 4) for beta in betas.tolist()],
            "frames": len(fit.motion.clip),
            "taken": chosen.name,
            "iou": {candidate.name: round(candidate.iou, 4) for candidate in fit.candidates},
            "views_left_out": fit.num_held_out,
            "new_poses": new_poses and {"iou": new_poses.iou, "iou_moved": new_poses.iou_moved},
            "by_avatar": [
                {"iou": x.before, "iou_posed": x.after, "views_left_out": x.num_held_out}
                for x in by_avatar
            ],
            "iou_per_frame": {
                str(frame): round(iou, 4)
                for frame, iou in zip(fit.motion.frames, chosen.per_frame, strict=False)
                if iou == iou
            },
        }
        write_text(folder / "fit_report.json", json.dumps(fields, indent=1) + "\n")
    candidates = ", ".join(f"{candidate.iou:.3f} {candidate.name}" for candidate in fit.candidates)
    worst = int(np.nanargmin(chosen.per_frame))
    label = "" if body.name == "anny" else f"{_template_label(model, body)}, "
    lines = [
        f"{label}{format_count(len(fit.motion.clip), 'frame')}; "
        f"silhouette IoU on {_evaluation_views(fit.num_held_out)}: {candidates}",
        f"chosen: {chosen.name}; worst frame {fit.motion.frames[worst]} (IoU "
        f"{chosen.per_frame[worst]:.3f}); see {out / 'fit_overlays.png'}",
        *(x.summary() for x in (cameras, new_poses, *by_avatar) if x is not None),
    ]
    if centre is not None:
        lines.append(
            f"one camera does not show the size: the person is taken to be {stature:.2f} m high; "
            "data.stature=METRES sets it"
        )
    return FittedCapture(out, fit, model, "\n".join(lines))


def _known_size_error(options: DataConfig) -> DyngsError:
    return DyngsError(
        f"data.stature={options.stature:g}: the size of the person in {options.root} is known from "
        "several camera positions, or from given poses; remove it"
    )


def _fixed_camera_centre(views: Sequence[View]) -> torch.Tensor | None:
    """Return the position (3,) of the camera in world coordinates; None if there are several."""
    poses = np.stack([view.cam_from_world for view in views])
    if not np.allclose(poses, poses[0], atol=1e-6):
        return None
    return torch.from_numpy(camera_center(poses[0])).float()


def _standing_height(body: BodyTemplate, fit: CaptureFit) -> float:
    """Return the height, m, of the fitted body in the rest pose, before it is scaled."""
    vertices, _ = apply_shape(body, fit.betas)
    return float(vertices[:, 1].max() - vertices[:, 1].min())


def _enlarge(motion: CapturedMotion, factor: float, centre: torch.Tensor) -> CapturedMotion:
    """Scale a person about the camera centre (3,), which leaves the images unchanged."""
    clip = motion.clip
    trans = centre + factor * (clip.trans - centre)
    return replace(motion, clip=replace(clip, trans=trans, scale=factor * clip.scale))


def _evaluation_views(num_held_out: int) -> str:
    return format_count(num_held_out, "held-out view") if num_held_out else "the fitted views"


def read_run_template(path: Path) -> HumanModel:
    """Return the template of an avatar's run; of anything else the free template."""
    model = load_resolved(path).model if (path / RESOLVED_NAME).is_file() else None
    if not isinstance(model, HumanModel):
        return HumanModel()
    return HumanModel(body=model.body, uv=model.uv)


def _template_label(model: HumanModel, body: BodyTemplate) -> str:
    """Return the name of a template for messages."""
    return body.name if model.body is None else f"{body.name} ({model.body.name})"


def _require_texels(model: HumanModel, body: BodyTemplate) -> None:
    """Raise DyngsError if the template has no UV map."""
    if body.uv is None:
        raise DyngsError(
            f"{model.body}: has no UV map, which the fit needs; pass the .obj that has it (--uv "
            "FILE, or model.uv=FILE in training)"
        )


def read_known_shape(path: Path, body: BodyTemplate) -> BodyFrames:
    """Return the body parameters of a known person, of which only the shape is used.

    ``path`` is a capture or folder that ``dyngs data fit`` wrote, or the run of an avatar trained
    on one. Raises DyngsError: none of these, or the shape of another template.
    """
    with wrap_read_errors(
        path, "give a capture that `dyngs data fit` wrote, or a run trained on it"
    ):
        folder = path
        if (path / RESOLVED_NAME).is_file():
            data = load_resolved(path).data
            # A run may store its fit in its own folder.
            folder = data.root if data.body is None else path / data.body
        if not (folder / _BODY).is_file():
            raise DyngsError(
                f"{path}: no fitted body; give a capture that `dyngs data fit` wrote, or its run"
            )
        body_frames = read_body_file(folder / _BODY)
    if not has_same_shape_space(body, body_frames):
        raise DyngsError(
            f"{folder / _BODY}: was fitted with another template than {body.name}; pass it with "
            "--template, or fit that person with `dyngs data fit` first"
        )
    return body_frames


def apply_known_shape(body: BodyTemplate, known: BodyFrames | None) -> BodyTemplate:
    """Return the template to fit: its mean shape is the known shape.

    Only the first ``NUM_FITTED_SHAPES`` shape parameters of SMPL-family files are kept.
    """
    if known is not None:
        vertices, joints = rest_shape(body, known)
        body = replace(body, vertices=vertices, joints=joints)
    if body.name == "anny" or body.shape_dirs is None or body.joint_shape_dirs is None:
        return body
    return replace(
        body,
        shape_dirs=body.shape_dirs[..., :NUM_FITTED_SHAPES],
        joint_shape_dirs=body.joint_shape_dirs[..., :NUM_FITTED_SHAPES],
    )


def known_betas(body: BodyTemplate, known: BodyFrames | None) -> torch.Tensor:
    """Return the known shape parameters (B,) of a template; unknown ones are 0."""
    betas = torch.zeros(body.num_shapes, device="cpu")
    if known is not None:
        stored = torch.from_numpy(known.betas[: len(betas)]).float()
        betas[: len(stored)] = stored
    return betas


def _at_most(options: DataConfig, longest_side: int) -> DataConfig:
    """Return reading options with a limit on the longest image side, px."""
    return options.model_copy(update={"longest_side": longest_side, "downscale": 1})


def read_person_capture(
    options: DataConfig, inputs: FitInputs, work: Path, log: Callable[[str], None] = log_info
) -> Capture:
    """Read a capture with silhouettes from a capture, a video, or a folder of images of one fixed
    camera.

    Masks of ``inputs`` replace those of the capture; without any they are estimated from the
    background and written to ``work``. Raises DyngsError: neither capture nor clip, or masks
    cannot be made.
    """
    source = options.root
    if options.format == "auto" and not is_capture(source) and is_image_sequence(source):
        capture = read_fixed_camera(options, inputs.masks)
        for line in capture.warnings:
            log(line)
    else:
        capture = read_capture(options)
        if inputs.masks is not None:
            splits: dict[Split, tuple[View, ...]] = {}
            for split, views in capture.splits.items():
                names = [f"{view.name}{view.image_path.suffix}" for view in views]
                masks = silhouettes_of(inputs.masks, names)
                splits[split] = tuple(
                    replace(view, silhouette=mask) for view, mask in zip(views, masks, strict=True)
                )
            capture = capture.replace(splits=splits, has_alpha=True)
    if not capture.has_alpha:
        if capture.format == "neuman":
            raise DyngsError(
                f"{source}: no silhouettes, and a moving camera; add masks of the person"
            )
        capture = add_background_masks(capture, work, log)
    if capture.format != FORMAT and inputs.masks is None:
        return capture
    # Estimated masks may be empty: skip views with less than a fifth of the usual area.
    areas = {split: _silhouette_areas(views, options) for split, views in capture.splits.items()}
    usual_area = sorted(areas["train"])[len(areas["train"]) * 3 // 4]
    visible: dict[Split, tuple[View, ...]] = {}
    skipped: list[str] = []
    for split, views in capture.splits.items():
        is_visible = [area > 0.2 * usual_area for area in areas[split]]
        visible[split] = tuple(compress(views, is_visible))
        skipped += [view.name for view, kept in zip(views, is_visible, strict=True) if not kept]
    if not visible["train"]:
        raise DyngsError(f"{capture.root}: the masks are empty; the person must be white")
    if skipped:
        log(
            f"skipped {format_count(len(skipped), 'view')} with (almost) empty masks, first "
            f"{skipped[0]}"
        )
    return capture.replace(splits={split: views for split, views in visible.items() if views})


def _silhouette_areas(views: Sequence[View], options: DataConfig) -> list[float]:
    """Return the fraction of each image that the silhouette covers."""
    images = ImageLoader(views, _at_most(options, 128))
    areas = []
    for i in range(len(views)):
        alpha = images[i].alpha
        areas.append(0.0 if alpha is None else float(alpha.mean()))
    return areas


SILHOUETTE_SIDE_PX = 320
"""Longest side of the compared silhouettes; an avatar trained on smaller images is compared at
their size."""


@dataclass(frozen=True)
class AvatarPoseFit:
    """Poses fitted with an avatar; used where they improve the silhouettes."""

    clip: CapturedMotion  # of all frames; unchanged if the IoU did not improve
    before: float  # silhouette IoU at some time steps
    after: float
    num_held_out: int  # views of that IoU; 0: measured on fitted views

    def summary(self) -> str:
        """Return a one-line summary."""
        decision = "used" if self.after > self.before else "not used"
        return (
            f"poses fitted with the avatar: {decision}; silhouette IoU on "
            f"{_evaluation_views(self.num_held_out)} {self.before:.3f} -> {self.after:.3f}"
        )


def fit_poses_by_avatar(
    avatar: KnownAvatar, views: Sequence[View], options: DataConfig, start: CapturedMotion
) -> AvatarPoseFit:
    """Fit the poses of a clip to silhouettes with a trained avatar; keep them if the IoU improves.

    Frames of ``start`` without an image keep their poses. The IoU is measured on one held-out view
    at each of up to three time steps with at least three views.
    """
    times = start.clip.times
    groups: dict[int, list[View]] = {}
    for view in views:
        row = start.rows[frame_number(view)]
        groups.setdefault(row, []).append(replace(view, time=float(times[row])))
    large = [group for group in groups.values() if len(group) >= 3]
    candidates = large or list(groups.values())
    chosen = [candidates[i] for i in evenly_spaced(len(candidates), 3)]
    held_out = [group[-1] for group in chosen] if large else []
    fit_views = [view for group in chosen for view in group if view not in held_out]
    sides = (SILHOUETTE_SIDE_PX, options.longest_side, avatar.longest_side)
    small = _at_most(options, min(side for side in sides if side))
    tested = ImageLoader(held_out or fit_views, small)
    scene = avatar.scene.with_motion(start.clip)

    def fitted(views: Sequence[View]) -> HumanScene:
        black = scene.gaussians.means.new_zeros(3)
        return fit_poses_to_images(scene, ImageLoader(views, small), black, SILHOUETTE_COMPARISON)[
            0
        ]

    before = _mean_iou(scene, tested)
    after = _mean_iou(fitted(fit_views), tested)
    clip = start.clip
    if after > before:
        fitted_clip = fitted([view for group in groups.values() for view in group]).replacement_clip
        if fitted_clip is not None:
            clip = clip.replace_rows(
                torch.searchsorted(times, fitted_clip.times).tolist(), fitted_clip
            )
    return AvatarPoseFit(replace(start, clip=clip), before, after, len(held_out))


@torch.no_grad()
def _mean_iou(scene: HumanScene, images: ImageLoader) -> float:
    """Return the mean silhouette IoU of the rendered person and the images."""
    ious = []
    for i in range(len(images)):
        image = images[i]
        rendered = scene.render(image.cameras, image.time, options=scene.options).alpha[0] > 0.5
        truth = rendered if image.alpha is None else image.alpha > 0.5
        ious.append(float((rendered & truth).sum() / (rendered | truth).sum().clamp_min(1)))
    return fmean(ious)


OVERLAY_SIDE_PX = 800  # longest image side in ``fit_overlays.png``, before cropping
CROP_MARGIN = 0.15
"""Margin around silhouettes in written images, as a fraction of the longest silhouette side."""
MIN_CROPPED = 0.3  # fraction of an image that cropping must save


def crop_windows(capture: Capture, options: DataConfig) -> dict[str, tuple[slice, slice]]:
    """Return rows and columns around the person by view name, of one size per camera.

    Cameras whose person fills most of the image are not cropped. Views with an empty mask get the
    window of the view before.
    """
    windows: dict[str, tuple[slice, slice]] = {}
    for views in group_by_camera(capture.splits).values():
        images = ImageLoader(views, _at_full_size(options))
        boxes = []
        for i in range(len(views)):
            alpha = images[i].alpha
            boxes.append(None if alpha is None else silhouette_box(alpha, 0.1))
        found = [box for box in boxes if box is not None]
        sides = [[part.stop - part.start for part in box] for box in found]
        if not found or len(set(images.sizes)) > 1:
            continue
        margin = 2 * round(CROP_MARGIN * max(map(max, sides)))
        width, height = images.sizes[0]
        size = [
            min(max(side[axis] for side in sides) + margin, whole)
            for axis, whole in enumerate((height, width))
        ]
        if size[0] * size[1] > (1 - MIN_CROPPED) * height * width:
            continue
        box = found[0]
        for view, own in zip(views, boxes, strict=True):
            box = own or box
            starts = [
                min(max((part.start + part.stop - length) // 2, 0), whole - length)
                for part, length, whole in zip(box, size, (height, width), strict=True)
            ]
            windows[view.name] = (
                slice(starts[0], starts[0] + size[0]),
                slice(starts[1], starts[1] + size[1]),
            )
    return windows


def _at_full_size(options: DataConfig) -> DataConfig:
    return options.model_copy(
        update={"longest_side": None, "downscale": 1, "body": None, "cache_mb": 0}
    )


def write_split(
    out: Path,
    split: Split,
    rows: Mapping[int, int],
    capture: Capture,
    options: DataConfig,
    windows: Mapping[str, tuple[slice, slice]],
) -> None:
    """Write ``transforms_SPLIT.json`` and the undistorted images of a split as PNG with straight
    alpha.

    Separate mask files stay separate (``silhouette_path``).

    Args:
        out: folder of the capture.
        split: that is written.
        rows: row of the body parameters by frame number.
        capture: with the views.
        options: of reading images.
        windows: rows and columns to keep, by view name; other images are kept whole.
    """
    views = capture.splits[split]
    if not views:
        return
    full = _at_full_size(options)
    images = ImageLoader(views, full)
    photos = ImageLoader([replace(view, silhouette=None) for view in views], full)
    frames: list[dict[str, object]] = []
    for i, view in enumerate(views):
        row = rows[frame_number(view)]
        stem = f"{split}/f{row:04d}_c{view.camera_id:02d}_{i:05d}.png"
        image = images[i]
        photo = photos[i]
        window = windows.get(
            view.name, (slice(0, image.cameras.height), slice(0, image.cameras.width))
        )
        parts = [photo.rgb_premultiplied]
        if photo.alpha is not None:
            parts.append(photo.alpha[..., None])
        pixels = to_straight_uint8(torch.cat(parts, dim=-1)[window]).numpy()
        write_image(out / f"images/{stem}", pixels)
        pose = to_opengl_pose(view.cam_from_world).copy()
        pose[:3, 3] = capture.world_scale * pose[:3, 3] + capture.world_offset
        fl_x, _, cx, _, fl_y, cy = image.cameras.intrinsics[0, :2].double().flatten().tolist()
        frame: dict[str, object] = {
            "file_path": f"images/{stem}",
            "frame": row,
            "camera": view.camera_id,
            "w": window[1].stop - window[1].start,
            "h": window[0].stop - window[0].start,
            "fl_x": fl_x,
            "fl_y": fl_y,
            "cx": cx - window[1].start,
            "cy": cy - window[0].start,
            "transform_matrix": pose.tolist(),
        }
        if view.time is not None:
            frame["time"] = view.time
        if view.silhouette is not None and image.alpha is not None:
            alpha = to_straight_uint8(image.alpha[window][..., None]).numpy()
            write_image(out / f"masks/{stem}", alpha)
            frame["silhouette_path"] = f"masks/{stem}"
        frames.append(frame)
    write_text(out / f"transforms_{split}.json", json.dumps({"frames": frames}, indent=1) + "\n")


def write_body_file(
    path: Path,
    motion: CapturedMotion,
    body: BodyTemplate,
    betas: np.ndarray,
    capture: Capture,
) -> None:
    """Write the body parameters of a clip, in file coordinates; the file can also be read as a
    motion.

    ``betas`` (B,) belong to the shape space of ``body``.
    """
    clip = motion.clip
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
            frames=np.asarray(motion.frames, dtype=np.int64),
            mocap_frame_rate=np.float64(capture.fps or 30),
        )


@torch.no_grad()
def _overlays(
    capture: Capture, options: DataConfig, body: BodyTemplate, fit: CaptureFit
) -> np.ndarray:
    """Return up to eight images of the person with body outlines: mean shape in the given pose
    (red) and the fit (green)."""
    views = capture.splits["train"]
    images = ImageLoader(views, _at_most(options, OVERLAY_SIDE_PX))
    discs = body_discs(body, 72)
    zero_padding = torch.zeros_like(discs.weights[:, 0])
    mean = discs.with_shape(torch.zeros_like(fit.betas), zero_padding)
    shaped = discs.with_shape(fit.betas, zero_padding)
    fitted = fit.clip
    sheets = []
    for i in evenly_spaced(len(views), 8):
        image = images[i]
        row = fit.motion.rows[frame_number(views[i])]
        sheet = image.composite(torch.ones(3, device="cpu")).clamp(0, 1).clone()
        for discs_in_shape, clip, colour in (
            (mean, fit.motion.clip, (0.9, 0.1, 0.1)),
            (shaped, fitted, (0.0, 0.7, 0.1)),
        ):
            silhouettes = render_silhouettes(
                discs_in_shape.in_pose(frame_pose(clip, row)), image.cameras
            )
            inside = silhouettes[0] > 0.5
            outside = (~inside).float()[None]
            near_edge = torch.nn.functional.max_pool2d(outside, 3, 1, 1)[0] > 0
            sheet[inside & near_edge] = sheet.new_tensor(colour)
        box = None if image.alpha is None else silhouette_box(image.alpha, 0.5)
        if box is not None:
            margin = round(CROP_MARGIN * max(part.stop - part.start for part in box))
            rows, columns = (slice(max(x.start - margin, 0), x.stop + margin) for x in box)
            sheet = sheet[rows, columns]
        sheets.append(sheet.numpy())
    height, width = (max(sheet.shape[axis] for sheet in sheets) for axis in (0, 1))
    whole = np.ones((2 * height, 4 * width, 3), np.float32)
    for i, sheet in enumerate(sheets):
        tile = whole[i // 4 * height :, i % 4 * width :]
        tile[: sheet.shape[0], : sheet.shape[1]] = sheet
    return whole


def ensure_fitted_body(
    data: DataConfig,
    model: HumanModel | None = None,
    *,
    only_if_needed: bool = False,
    log: Callable[[str], None] = log_info,
    on_progress: ProgressCallback = ignore_progress,
) -> DataConfig:
    """Return options for the capture with a fitted body; the fit is cached per capture.

    ``model`` names the template; None: the free one. Nothing is fitted if ``data.body`` names a
    fit, if the capture has one of this template, or without silhouettes; with ``only_if_needed``
    also not if the capture has body parameters. Raises DyngsError: neither body parameters nor
    silhouettes, or a template that cannot be read.
    """
    model = model or HumanModel()
    if data.body is not None:
        path = data.body / _BODY
        if path.is_file() and not has_same_shape_space(load_template(model), read_body_file(path)):
            log(
                f"body:    {data.body} was fitted with another template; using its poses, not its "
                "shape"
            )
        return data
    capture = read_capture(data)
    body_frames = None if capture.body is None else capture.body["train"]
    if body_frames is not None and data.stature is not None:
        raise _known_size_error(data)
    if body_frames is not None and only_if_needed:
        return data
    body = load_template(model)
    if body_frames is not None:
        # Only dyngs writes shapes of the free template.
        fitted_template = body_frames.shape_space if body.name == "anny" else body_frames.fitted_to
        if fitted_template in ("anny", body.fingerprint):
            return data
    if not capture.has_alpha:
        if body_frames is None:
            raise DyngsError(
                f"{data.root}: has neither silhouettes nor body parameters; add masks of the "
                "person (`dyngs docs people`)"
            )
        log(f"{data.root}: no silhouettes; using the body parameters of the capture")
        return data
    _require_texels(model, body)
    suffix = "" if model.body is None else f".{body.fingerprint}"
    name = re.sub(r"[^A-Za-z0-9-]", "_", data.root.name)[:40]
    folder = cache_folder("bodies") / f"{name}.{_digest(data)}{suffix}"

    def run_fit() -> None:
        log(
            f"body:    fitting {_template_label(model, body)} to the silhouettes (see "
            f"`dyngs data fit`), result in {folder}"
        )
        keypoints = data.root / "keypoints"  # as OpenPose writes them
        inputs = FitInputs(keypoints if keypoints.is_dir() else None, template=model)
        log(write_fitted_capture(data, folder, on_progress, inputs, with_images=False).summary)

    make_once(folder, run_fit, log, f"body:    using the cached fit in {folder}")
    return data.model_copy(update={"body": folder})


def _digest(data: DataConfig) -> str:
    """Return a hash of the capture's files (name, size, time of change) and of the options that
    select views.

    Files above 100 MB, such as videos, hold neither bodies nor cameras and are skipped.
    """
    root = data.root.resolve()
    with wrap_read_errors(root):
        paths = [path for path in root.rglob("*") if path.is_file()]
        files = sorted(path for path in paths if path.stat().st_size < 100_000_000)
    names = (
        "format frames pose_frames train_cameras times frames_per_second test_every test_first "
        "skip_missing stature"
    )
    options = data.model_dump(mode="json", include=set(names.split()))
    options_hash = hashlib.sha256(repr(sorted(options.items())).encode()).hexdigest()[:8]
    return f"{digest_files(root, files)}{options_hash}"
