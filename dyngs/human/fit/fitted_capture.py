"""``dyngs data fit``: a capture of a person with the body fitted to it, and a report of the fit."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from dyngs.data.capture import BodyFrames, Capture, Split, View
from dyngs.data.geometry import to_opengl_pose
from dyngs.data.images.images import to_straight_uint8
from dyngs.data.loader import ImageLoader
from dyngs.data.read import is_capture, read_capture
from dyngs.data.times import evenly_spaced
from dyngs.human.avatar.pose_fit import SILHOUETTE_COMPARISON, fit_poses_to_images
from dyngs.human.avatar.posing import frame_pose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body import NUM_FITTED_SHAPES, BodyTemplate
from dyngs.human.body.body_reader import has_same_shape_space, load_template, rest_shape
from dyngs.human.fit.capture_fit import (
    CaptureFit,
    body_discs,
    collect_fitted_clips,
    fit_capture,
    place_new_poses,
    render_silhouettes,
)
from dyngs.human.fit.keypoints import read_joints, read_keypoints
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import CapturedMotion
from dyngs.io.outputs import atomic_folder, make_once
from dyngs.io.write import atomic_file, cache_folder, write_image, write_text

_BODY = "body_train.npz"


@dataclass(frozen=True)
class KnownAvatar:
    """The avatar of a person, and the longest side of the images it was trained on, px; None: as
    they are."""

    scene: HumanScene
    longest_side: int | None


@dataclass(frozen=True)
class FitInputs:
    """What is given next to the capture; everything may be None."""

    keypoints: Path | None = None  # folder or file of 2D key points
    masks: Path | None = None  # folder of masks, white = the person
    # image of the place without the person, or a folder of one for each camera
    background: Path | None = None
    joints: Path | None = None  # file or folder of 3D joints, see ``read_joints``
    person: Path | None = None  # capture or run of the same person, whose shape is kept
    # of the same person, if that run has one: its silhouette decides the poses in the end
    avatar: KnownAvatar | None = None
    template: HumanModel = field(default_factory=HumanModel)  # names the body file that is fitted


@dataclass(frozen=True)
class FittedCapture:
    """Result of ``write_fitted_capture``: the new capture's folder and the fit."""

    root: Path
    found: CaptureFit
    model: HumanModel  # names the template
    summary: str  # lines for people: how good the fit is


def write_fitted_capture(
    options: DataConfig,
    out: Path,
    report: ProgressCallback,
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
    model = given.template
    if given.person is not None and model.body is None:
        model = read_run_template(given.person)
    body = load_template(model)
    _require_texels(model, body)
    person = None if given.person is None else read_known_shape(given.person, body)
    with atomic_folder(out) as folder:
        masks = folder / ".masks"
        capture = read_person_capture(options, given, masks)
        capture = capture.replace(splits=assign_frame_numbers(capture.splits))
        views = capture.splits["train"]
        # The fit begins with the shape of a known person, or with that of the capture.
        first = person
        if first is None and body.name != "anny" and capture.body is not None:
            given_body = capture.body["train"]
            first = given_body if has_same_shape_space(body, given_body) else None
        shaped = apply_known_shape(body, first)
        found = fit_capture(
            capture,
            options,
            shaped,
            report,
            None if given.keypoints is None else read_keypoints(given.keypoints, views),
            joints=None if given.joints is None else read_joints(given.joints, capture),
            one_camera=capture.format == FORMAT,
            shape_known=person is not None,
        )
        betas = known_betas(body, first)
        betas[: len(found.betas)] += found.betas
        new_poses = place_new_poses(capture, options, shaped, found, report)
        clips = collect_fitted_clips(capture, shaped, found, new_poses)
        by_avatar: list[AvatarPoseFit] = []
        if given.avatar is not None:
            for split, clip in clips.items():
                posed = fit_poses_by_avatar(given.avatar, capture.splits[split], options, clip)
                clips[split] = posed.clip
                by_avatar.append(posed)
        if with_images:
            for split in capture.splits:
                write_split(folder, split, clips.get(split, clips["train"]).rows, capture, options)
            clips = {
                split: replace(clip, frames=tuple(range(len(clip.frames))))
                for split, clip in clips.items()
            }
        for split, clip in clips.items():
            write_body_file(folder / f"body_{split}.npz", clip, body, betas.numpy(), capture)
        write_image(folder / "fit_overlays.png", _overlays(capture, options, shaped, found))
        shutil.rmtree(masks, ignore_errors=True)
        chosen = found.chosen
        fields = {
            "template": _called(model, body),
            "betas": [round(beta, 4) for beta in betas.tolist()],
            "frames": len(found.motion.clip),
            "taken": chosen.name,
            "iou": {candidate.name: round(candidate.iou, 4) for candidate in found.tried},
            "views_left_out": found.num_held_out,
            "new_poses": new_poses and {"iou": new_poses.iou, "iou_moved": new_poses.iou_moved},
            "by_avatar": [
                {"iou": x.before, "iou_posed": x.after, "views_left_out": x.left_out}
                for x in by_avatar
            ],
            "iou_per_frame": {
                str(frame): round(iou, 4)
                for frame, iou in zip(found.motion.frames, chosen.per_frame, strict=False)
                if iou == iou
            },
        }
        write_text(folder / "fit_report.json", json.dumps(fields, indent=1) + "\n")
    tried = ", ".join(f"{candidate.iou:.3f} with {candidate.name}" for candidate in found.tried)
    worst = int(np.nanargmin(chosen.per_frame))
    lines = [
        f"{'' if body.name == 'anny' else _called(model, body) + ', '}{format_count(len(found.motion.clip), 'frame')}; "
        f"overlap of silhouettes (IoU) on {_judged_on(found.num_held_out)}: {tried}",
        f"taken: {chosen.name}; worst frame {found.motion.frames[worst]} with {chosen.per_frame[worst]:.3f}; look at "
        f"{out / 'fit_overlays.png'}",
        *(x.summary() for x in (new_poses, *by_avatar) if x is not None),
    ]
    return FittedCapture(out, found, model, "\n".join(lines))


def _judged_on(left_out: int) -> str:
    return (
        f"{format_count(left_out, 'view')} left out of the fit"
        if left_out
        else "the views fitted to"
    )


def read_run_template(path: Path) -> HumanModel:
    """Return what names the template of an avatar's run, of anything else the free one."""
    model = load_resolved(path).model if (path / RESOLVED_NAME).is_file() else None
    if not isinstance(model, HumanModel):
        return HumanModel()
    return HumanModel(body=model.body, uv=model.uv)


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


def read_known_shape(path: Path, body: BodyTemplate) -> BodyFrames:
    """Return the body parameters of a person, of whom only the shape counts, which is one of
    ``body``.

    ``path`` is a capture or a folder that ``dyngs data fit`` wrote, or the run of an avatar trained
    on one. Raises DyngsError: none of these, or a shape of another template.
    """
    with wrap_read_errors(
        path, "give a capture that `dyngs data fit` wrote, or a run trained on it"
    ):
        folder = path
        if (path / RESOLVED_NAME).is_file():
            data = load_resolved(path).data
            # The fit of a run may lie in its folder.
            folder = data.root if data.body is None else path / data.body
        if not (folder / _BODY).is_file():
            raise DyngsError(
                f"{path}: no fitted person there; give a capture that `dyngs data fit` wrote, or its run"
            )
        found = read_body_file(folder / _BODY)
    if not has_same_shape_space(body, found):
        raise DyngsError(
            f"{folder / _BODY}: is of another template than {body.name}; name that of the person with --template, or "
            "fit that person with `dyngs data fit` first"
        )
    return found


def apply_known_shape(body: BodyTemplate, known: BodyFrames | None) -> BodyTemplate:
    """Return the template that is fitted: its mean shape is that of a known person.

    Of a file of SMPL's family it has the first ``NUM_FITTED`` shape parameters.
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
    """Return the known shape parameters (B,) of a template with B of them; 0 for those that are not
    known."""
    betas = torch.zeros(body.num_shapes, device="cpu")
    if known is not None:
        given = torch.from_numpy(known.betas[: len(betas)]).float()
        betas[: len(given)] = given
    return betas


def _at_most(options: DataConfig, longest_side: int) -> DataConfig:
    """Return the options of reading smaller images."""
    return options.model_copy(update={"longest_side": longest_side, "downscale": 1})


def read_person_capture(
    options: DataConfig, given: FitInputs, work: Path, log: Callable[[str], None] = log_info
) -> Capture:
    """Return a capture with silhouettes: of a capture, or a video or a folder of images of one
    fixed camera.

    Masks of ``given`` take the place of those of the capture; without any they are made from the
    background, in the folder ``work``. Raises DyngsError: neither capture nor clip; no masks, and
    none that can be made.
    """
    source = options.root
    if options.format == "auto" and not is_capture(source) and is_image_sequence(source):
        capture = read_fixed_camera(options, given.masks)
        for line in capture.warnings:
            log(line)
    else:
        capture = read_capture(options)
        if given.masks is not None:
            splits: dict[Split, tuple[View, ...]] = {}
            for split, views in capture.splits.items():
                names = [f"{view.name}{view.image_path.suffix}" for view in views]
                found = silhouettes_of(given.masks, names)
                splits[split] = tuple(
                    replace(view, silhouette=own) for view, own in zip(views, found, strict=True)
                )
            capture = capture.replace(splits=splits, has_alpha=True)
    if given.background is not None or not capture.has_alpha:
        if capture.format == "neuman":
            raise DyngsError(
                f"{source}: no silhouettes, and the camera moves; add masks of the person"
            )
        capture = add_background_masks(capture, work, given.background, log)
    if capture.format != FORMAT and given.masks is None:
        return capture
    # Found masks may be empty: frames with less than a fifth of the usual area are left out.
    views = capture.splits["train"]
    images = ImageLoader(views, _at_most(options, 128))
    areas = []
    for i in range(len(views)):
        alpha = images[i].alpha
        areas.append(0.0 if alpha is None else float(alpha.mean()))
    usual = sorted(areas)[len(areas) * 3 // 4]
    kept = tuple(view for view, area in zip(views, areas, strict=True) if area > 0.2 * usual)
    if not kept:
        raise DyngsError(f"{capture.root}: nobody is seen in the masks; white is the person")
    if len(kept) < len(views):
        gone = next(view.name for view in views if view not in kept)
        log(
            f"{len(views) - len(kept)} frames in which hardly anybody is seen are left out, first {gone}"
        )
    return capture.replace(splits={**capture.splits, "train": kept})


SILHOUETTE_SIDE_PX = 320
"""Of the images whose silhouettes are looked at, px, at most; an avatar trained on smaller ones is
compared at that size, since its edges are those of its images."""


@dataclass(frozen=True)
class AvatarPoseFit:
    """Poses that an avatar found; taken where they are better than those before."""

    clip: CapturedMotion  # of all frames; as it was where the overlap did not grow
    before: float  # overlap of silhouettes (IoU) at some time steps, of the avatar
    after: float
    # number of views, which were left out of the fit, that this was measured on; 0: on those fitted
    # to
    left_out: int

    def summary(self) -> str:
        """Return a line for people."""
        taken = "taken" if self.after > self.before else "not taken"
        return (
            f"poses by the silhouette of the person's avatar: {taken}; overlap on {_judged_on(self.left_out)} "
            f"{self.before:.3f} -> {self.after:.3f}"
        )


def fit_poses_by_avatar(
    avatar: KnownAvatar, views: Sequence[View], options: DataConfig, start: CapturedMotion
) -> AvatarPoseFit:
    """Return the poses of a clip in which the avatar has the silhouettes of its images, where that
    is better.

    Frames of ``start`` without an image keep their poses. One view of each of up to three time
    steps with at least three views is left out to see what the fit is worth.
    """
    times = start.clip.times
    groups: dict[int, list[View]] = {}
    for view in views:
        row = start.rows[frame_number(view)]
        groups.setdefault(row, []).append(replace(view, time=float(times[row])))
    enough = [group for group in groups.values() if len(group) >= 3]
    some = enough or list(groups.values())
    chosen = [some[i] for i in evenly_spaced(len(some), 3)]
    left_out = [group[-1] for group in chosen] if enough else []
    others = [view for group in chosen for view in group if view not in left_out]
    sides = (SILHOUETTE_SIDE_PX, options.longest_side, avatar.longest_side)
    small = _at_most(options, min(side for side in sides if side))
    tested = ImageLoader(left_out or others, small)
    scene = avatar.scene.with_motion(start.clip)

    def fitted(views: Sequence[View]) -> HumanScene:
        nothing = scene.gaussians.means.new_zeros(3)
        return fit_poses_to_images(
            scene, ImageLoader(views, small), nothing, SILHOUETTE_COMPARISON
        )[0]

    before = _overlap(scene, tested)
    after = _overlap(fitted(others), tested)
    clip = start.clip
    if after > before:
        found = fitted([view for group in groups.values() for view in group]).replacement_clip
        if found is not None:
            clip = clip.replace_rows(torch.searchsorted(times, found.times).tolist(), found)
    return AvatarPoseFit(replace(start, clip=clip), before, after, len(left_out))


@torch.no_grad()
def _overlap(scene: HumanScene, images: ImageLoader) -> float:
    """Return the mean intersection over union of the silhouettes of the person and of images."""
    found = []
    for i in range(len(images)):
        image = images[i]
        drawn = scene.render(image.cameras, image.time, options=scene.options).alpha[0] > 0.5
        truth = drawn if image.alpha is None else image.alpha > 0.5
        found.append(float((drawn & truth).sum() / (drawn | truth).sum().clamp_min(1)))
    return fmean(found)


def write_split(
    out: Path, split: Split, rows: Mapping[int, int], capture: Capture, options: DataConfig
) -> None:
    """Write ``transforms_SPLIT.json`` and the images of a split as PNG with straight alpha,
    undistorted.

    Where masks are files beside the images, they stay so (``silhouette_path``). ``rows`` are those
    of the body parameters by frame number.
    """
    views = capture.splits[split]
    if not views:
        return
    full = options.model_copy(
        update={"longest_side": None, "downscale": 1, "body": None, "cache_mb": 0}
    )
    images = ImageLoader(views, full)
    photos = ImageLoader([replace(view, silhouette=None) for view in views], full)
    frames: list[dict[str, object]] = []
    for i, view in enumerate(views):
        row = rows[frame_number(view)]
        stem = f"{split}/f{row:04d}_c{view.camera_id:02d}_{i:05d}.png"
        image = images[i]
        photo = photos[i]
        parts = [photo.rgb_premultiplied]
        if photo.alpha is not None:
            parts.append(photo.alpha[..., None])
        write_image(out / f"images/{stem}", to_straight_uint8(torch.cat(parts, dim=-1)).numpy())
        pose = to_opengl_pose(view.cam_from_world).copy()
        pose[:3, 3] = capture.world_scale * pose[:3, 3] + capture.world_offset
        fl_x, _, cx, _, fl_y, cy = image.cameras.intrinsics[0, :2].double().flatten().tolist()
        frame: dict[str, object] = {
            "file_path": f"images/{stem}",
            "frame": row,
            "camera": view.camera_id,
            "w": image.cameras.width,
            "h": image.cameras.height,
            "fl_x": fl_x,
            "fl_y": fl_y,
            "cx": cx,
            "cy": cy,
            "transform_matrix": pose.tolist(),
        }
        if view.time is not None:
            frame["time"] = view.time
        if view.silhouette is not None and image.alpha is not None:
            write_image(out / f"masks/{stem}", to_straight_uint8(image.alpha[..., None]).numpy())
            frame["silhouette_path"] = f"masks/{stem}"
        frames.append(frame)
    write_text(out / f"transforms_{split}.json", json.dumps({"frames": frames}, indent=1) + "\n")


def write_body_file(
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
            mocap_frame_rate=np.float64(capture.fps or 30),
        )


@torch.no_grad()
def _overlays(
    capture: Capture, options: DataConfig, body: BodyTemplate, found: CaptureFit
) -> np.ndarray:
    """Return up to eight images with outlines: the mean shape in the given pose in red, the fit in
    green."""
    views = capture.splits["train"]
    images = ImageLoader(views, _at_most(options, 400))
    discs = body_discs(body, 72)
    nothing = torch.zeros_like(discs.weights[:, 0])
    mean = discs.with_shape(torch.zeros_like(found.betas), nothing)
    shaped = discs.with_shape(found.betas, nothing)
    fitted = found.clip
    sheets = []
    for i in evenly_spaced(len(views), 8):
        image = images[i]
        row = found.motion.rows[frame_number(views[i])]
        sheet = image.composite(torch.ones(3, device="cpu")).clamp(0, 1).clone()
        for person, clip, colour in (
            (mean, found.motion.clip, (0.9, 0.1, 0.1)),
            (shaped, fitted, (0.0, 0.7, 0.1)),
        ):
            drawn = render_silhouettes(person.in_pose(frame_pose(clip, row)), image.cameras)
            inside = drawn[0] > 0.5
            outside = (~inside).float()[None]
            near_edge = torch.nn.functional.max_pool2d(outside, 3, 1, 1)[0] > 0
            sheet[inside & near_edge] = sheet.new_tensor(colour)
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
    report: ProgressCallback = ignore_progress,
) -> DataConfig:
    """Return the options with a fit of a template to the capture; the same capture is fitted once.

    ``model`` names the template; None: the free one. Nothing is fitted where ``data.body`` names a
    fit, where the capture holds one of this template, or without silhouettes; with
    ``only_if_needed`` where it has body parameters. Raises DyngsError: neither body parameters nor
    silhouettes, or a template that cannot be read.
    """
    model = model or HumanModel()
    if data.body is not None:
        path = data.body / _BODY
        if path.is_file() and not has_same_shape_space(load_template(model), read_body_file(path)):
            log(
                f"body:    {data.body} is a fit of another template: its poses are taken, not its shape"
            )
        return data
    capture = read_capture(data)
    given = None if capture.body is None else capture.body["train"]
    if given is not None and only_if_needed:
        return data
    body = load_template(model)
    if given is not None:
        # Of the free template nobody else has the shape space.
        own_fit = given.shape_space if body.name == "anny" else given.fitted_to
        if own_fit in ("anny", body.fingerprint):
            return data
    if not capture.has_alpha:
        if given is None:
            raise DyngsError(
                f"{data.root}: has neither silhouettes nor body parameters, so no person can be found; add masks of "
                "the person (`dyngs docs people`)"
            )
        log(f"{data.root}: no silhouettes, so the body parameters are taken as given")
        return data
    _require_texels(model, body)
    own = "" if model.body is None else f".{body.fingerprint}"
    name = re.sub(r"[^A-Za-z0-9-]", "_", data.root.name)[:40]
    folder = cache_folder("bodies") / f"{name}.{_digest(data)}{own}"

    def fit() -> None:
        log(
            f"body:    {_called(model, body)} is fitted to the silhouettes first, as by `dyngs data fit`, into {folder}"
        )
        points = data.root / "keypoints"  # as OpenPose writes them
        inputs = FitInputs(points if points.is_dir() else None, template=model)
        log(write_fitted_capture(data, folder, report, inputs, with_images=False).summary)

    make_once(folder, fit, log, f"body:    the fit of before, in {folder}")
    return data.model_copy(update={"body": folder})


def _digest(data: DataConfig) -> str:
    """Return a digest of the capture's files (names, sizes, times of change) and of the options of
    reading it.

    Files beyond 100 MB, such as videos, say nothing about bodies and cameras.
    """
    root = data.root.resolve()
    with wrap_read_errors(root):
        found = [path for path in root.rglob("*") if path.is_file()]
        files = sorted(path for path in found if path.stat().st_size < 100_000_000)
    names = (
        "format frames pose_frames train_cameras times frames_per_second test_every skip_missing"
    )
    options = data.model_dump(mode="json", include=set(names.split()))
    chosen = hashlib.sha256(repr(sorted(options.items())).encode()).hexdigest()[:8]
    return f"{digest_files(root, files)}{chosen}"
