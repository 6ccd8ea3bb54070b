"""Reader for ZJU-MoCap: ``annots.npy`` of several cameras, or ``cameras.pkl`` and
``mesh_infos.pkl`` of one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.body_frames import (
    build_body_frames,
    match_frames,
    parse_frame_number,
    share_body_across_splits,
)
from dyngs.data.capture import BodyFrames, Capture, CaptureFormat, Silhouette, Splits
from dyngs.data.geometry import to_opengl_pose, validate_pose
from dyngs.data.readers.camera_folders import MIN_CAMERAS_TO_HOLD_OUT
from dyngs.data.readers.transforms import FrameEntry, FrameFile, read_views
from dyngs.io.containment import check_inside
from dyngs.io.fields import parse_numbers, require_key
from dyngs.io.pickles import read_pickle, read_pickled_array

ANNOTATIONS = "annots.npy"
CAMERAS = "cameras.pkl"
MESHES = "mesh_infos.pkl"
FIRST_HELD_OUT = "no test camera given; the first camera is held out"


def read_zju_mocap(root: Path) -> Capture:
    """Read the capture of a person by one or several calibrated fixed cameras; units are metres.

    ``annots.npy`` (Peng et al. 2021) contains ``cams`` (K, D, R, T in mm, per camera) and ``ims``
    (images of all cameras per frame). SMPL parameters are in ``new_params/N.npy`` or
    ``params/N.npy``, where N is the number in the image name; masks (labels, 0 is background) in
    ``mask_cihp``, ``mask`` or ``masks`` under the image names. Of three cameras or more the first
    one is for testing. ``cameras.pkl`` and ``mesh_infos.pkl`` (Weng et al. 2022) contain the same
    per image of ``images/``, in metres; masks (white) are in ``masks/``.

    Parameters: v = Rh LBS(x; poses) + Th, about the template's origin; Rh becomes
    ``BodyFrames.origin_rotations``. The cameras were calibrated with OpenCV, whose pixel centres
    are integers, so half a pixel is added to the principal point.
    """
    shots: list[Any]
    if (root / ANNOTATIONS).is_file():
        path = root / ANNOTATIONS
        with wrap_read_errors(path):
            shots = _annotated_shots(path)
        numbers = sorted({shot.own["frame"] for shot in shots})
        found = next((x for x in (root / "new_params", root / "params") if x.is_dir()), root)
        files = [found / f"{number}.npy" for number in numbers]
        body = _body(found, numbers, [(str(x), read_pickled_array(check_inside(x))) for x in files])
        kind, folders = "nonzero", ("mask_cihp", "mask", "masks")
    else:
        path = root / CAMERAS
        with wrap_read_errors(path):
            shots = _single_shots(path)
        found = root / MESHES
        with wrap_read_errors(found):
            by_name = _by_name(found)
            infos = [(f"{found}, {name}", own) for name, own in by_name.items()]
            body = _body(found, [parse_frame_number(found, name) for name in by_name], infos)
            pelvis = np.mean(_column(infos, "tpose_joints", 72), axis=0)[:3]
            body = replace(body, pelvis=pelvis)
        kind, folders = "white", ("masks",)
    numbers = [shot.own["frame"] for shot in shots]
    first = min(numbers)
    last = max(numbers)
    for shot in shots:
        shot.own["time"] = (shot.own["frame"] - first) / max(last - first, 1)
    read, warnings = read_views(FrameFile(path, shots))
    match_frames(found, body, list(read.values()))
    people = []
    without = []
    for view, shot in zip(read.values(), shots, strict=True):
        mask = _mask(root, shot.own["file_path"], folders)
        people.append(replace(view, silhouette=None if mask is None else Silhouette(mask, kind)))
        without += [view.name] if mask is None else []
    if without:
        warnings.append(
            f"{len(without)} images have no mask in {' or '.join(folders)}, first {without[0]}"
        )
    splits: Splits = {"train": tuple(people)}
    if len({view.camera_id for view in people}) >= MIN_CAMERAS_TO_HOLD_OUT:
        splits = {
            "train": tuple(view for view in people if view.camera_id != 0),
            "test": tuple(view for view in people if view.camera_id == 0),
        }
        warnings.append(FIRST_HELD_OUT)
    return Capture(
        root, "zju_mocap", splits, body=share_body_across_splits(body), warnings=tuple(warnings)
    )


def _annotated_shots(path: Path) -> list[FrameEntry]:
    """Return the frames of all cameras in ``annots.npy``."""
    fields: Any = read_pickled_array(check_inside(path))
    cams = fields["cams"]
    calibrations = []
    for k, d, r, t in zip(*(cams[key] for key in ("K", "D", "R", "T")), strict=True):
        where = f"{path}, camera {len(calibrations)}"
        pose = np.eye(4)
        pose[:3, :3] = parse_numbers(f"{where}: 'R'", r, (3, 3))
        pose[:3, 3] = parse_numbers(f"{where}: 'T'", t, (3,)) / 1000
        calibrations.append(_calibration(where, k, d, pose))
    shots = []
    for own in fields["ims"]:
        frame = parse_frame_number(path, own["ims"][0])
        for camera, (file, calibration) in enumerate(zip(own["ims"], calibrations, strict=True)):
            fields_of = calibration | {"file_path": str(file), "camera": camera, "frame": frame}
            shots.append(FrameEntry(f"{path}, camera {camera}", fields_of))
    if not shots:
        raise DyngsError(f"{path}: 'ims' lists no images; export it again")
    return shots


def _single_shots(path: Path) -> list[FrameEntry]:
    """Return the frames of the camera in ``cameras.pkl``."""
    shots = []
    for name, own in sorted(_by_name(path).items()):
        where = f"{path}, {name}"
        pose = parse_numbers(
            f"{where}: 'extrinsics'", require_key(where, own, "extrinsics"), (4, 4)
        )
        lens = own.get("distortions", np.zeros(5))
        calibration = _calibration(where, require_key(where, own, "intrinsics"), lens, pose)
        frame = parse_frame_number(path, name)
        fields = calibration | {"file_path": f"images/{name}", "camera": 0, "frame": frame}
        shots.append(FrameEntry(where, fields))
    return shots


def _body(path: Path, numbers: list[int], rows: Sequence[tuple[str, Any]]) -> BodyFrames:
    """Return the body parameters, given a dictionary per frame and its name for messages."""
    names = [key for key in ("betas", "shapes") if all(key in own for _, own in rows)]
    betas = _column(rows, names[0]) if names else np.zeros(10)
    poses = _column(rows, "poses")
    trans = _column(rows, "Th", 3)
    turns = _column(rows, "Rh", 3)
    return build_body_frames(path, numbers, poses, trans, betas, origin_rotations=turns)


def _column(
    rows: Sequence[tuple[str, object]], key: str, width: int | None = None
) -> list[np.ndarray]:
    """Return the finite numbers at ``key`` of each dictionary, ``width`` of them if given."""
    shape = None if width is None else (width,)
    return [
        parse_numbers(f"{where}: '{key}'", require_key(where, own, key), shape)
        for where, own in rows
    ]


def _calibration(
    where: str, intrinsics: object, lens: object, cam_from_world: np.ndarray
) -> dict[str, Any]:
    k = parse_numbers(f"{where}: the intrinsics", intrinsics, (3, 3))
    values = parse_numbers(f"{where}: the distortion", lens, None).tolist()
    if len(values) not in (4, 5, 8):
        raise DyngsError(
            f"{where}: the distortion must have 4, 5 or 8 coefficients, got {len(values)}; "
            "export it again"
        )
    pose, _ = validate_pose(cam_from_world, where)
    return {
        "fl_x": float(k[0, 0]),
        "fl_y": float(k[1, 1]),
        "cx": float(k[0, 2]) + 0.5,
        "cy": float(k[1, 2]) + 0.5,
        "camera_model": "FULL_OPENCV" if len(values) == 8 else "OPENCV",
        **dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), values, strict=False)),
        "transform_matrix": to_opengl_pose(pose).tolist(),
    }


def _mask(root: Path, file: str, folders: Sequence[str]) -> Path | None:
    """Find the mask ``FOLDER/a/b.png`` of ``a/b.jpg`` or ``images/a/b.jpg`` in the first folder
    with one."""
    name = PurePosixPath(file.replace("\\", "/")).with_suffix("")
    below = [f"{name}.png", f"{name}.png".removeprefix("images/")]
    candidates = [root / folder / path for folder in folders for path in below]
    return next((path for path in candidates if path.is_file()), None)


def _by_name(path: Path) -> dict[str, dict[str, object]]:
    fields: Any = read_pickle(check_inside(path))
    for name in fields:
        if not re.fullmatch(r"[\w-]+", name):
            raise DyngsError(f"{path}: {name!r:.80} is not an image name; export it again")
    return fields


FORMAT = CaptureFormat(
    "zju_mocap",
    f"{ANNOTATIONS}, or {CAMERAS} and {MESHES}",
    lambda root: (
        (root / ANNOTATIONS).is_file()
        or ((root / CAMERAS).is_file() and (root / "images").is_dir())
    ),
    read_zju_mocap,
)
