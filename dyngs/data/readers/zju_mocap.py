"""Reader for ZJU-MoCap folders: ``annots.npy`` of several cameras, or ``cameras.pkl`` and
``mesh_infos.pkl`` of one."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import body_frames, of_one_clip, rows_of
from dyngs.data.capture import BodyFrames, Capture, CaptureFormat, Silhouette, Splits, View
from dyngs.data.geometry import checked_pose, opengl_from_cam
from dyngs.data.readers.camera_folders import MIN_CAMERAS_TO_HOLD_OUT
from dyngs.data.readers.transforms import FrameEntry, FrameFile, read_views
from dyngs.io.containment import inside
from dyngs.io.fields import entry, first_few, numbers_of
from dyngs.io.pickles import read_pickle, read_pickled_array

ANNOTATIONS = "annots.npy"
CAMERAS = "cameras.pkl"
MESHES = "mesh_infos.pkl"
FIRST_HELD_OUT = "no camera is named for testing: the first one is held out"

_MASK_FOLDERS = ("mask_cihp", "mask", "masks")
_NUM_JOINTS = 24


def read_zju_mocap(root: Path) -> Capture:
    """Read the capture of a person by several calibrated static cameras or by one; units are
    metres.

    ``annots.npy`` (Peng et al. 2021) holds ``cams`` (K, D, R, T in mm, per camera) and ``ims``
    (images of all cameras per frame); SMPL parameters lie in ``new_params/N.npy`` or
    ``params/N.npy``, N being the number in the image's name; masks (labels, 0 is background) in
    ``mask_cihp``, ``mask`` or ``masks`` under the images' names. Of three cameras or more the first
    one is for testing. ``cameras.pkl`` and ``mesh_infos.pkl`` (Weng et al. 2022) hold the same per
    image of ``images/``, in metres; masks (white) lie in ``masks/``.

    Parameters: v = Rh LBS(x; poses) + Th, about the template's origin: kept as
    ``BodyFrames.turns``. OpenCV calibrated these cameras, with pixel centres at whole numbers: half
    a pixel is added to the principal point.
    """
    if (root / ANNOTATIONS).is_file():
        path = root / ANNOTATIONS
        shots = _annotated_shots(root / ANNOTATIONS)
        found, body = _params_per_file(root, {number for number, _ in shots})
        person, folders = "nonzero", _MASK_FOLDERS
    else:
        path = root / CAMERAS
        shots = _single_shots(root / CAMERAS)
        found = root / MESHES
        body = _mesh_infos(root / MESHES)
        person = "white"
        folders = ("masks",)
    first = min(number for number, _ in shots)
    last = max(number for number, _ in shots)
    for number, shot in shots:
        shot.own["time"] = (number - first) / max(last - first, 1)
    read, warnings = read_views(FrameFile(path, [shot for _, shot in shots]))
    views = list(read.values())
    rows_of(found, body, views)
    masks = [_mask(root, str(shot.own["file_path"]), folders) for _, shot in shots]
    people = [
        replace(view, silhouette=None if mask is None else Silhouette(mask, person))
        for view, mask in zip(views, masks, strict=True)
    ]
    without = [view.name for view, mask in zip(views, masks, strict=True) if mask is None]
    if without:
        warnings.append(
            f"{len(without)} images have no mask in {' or '.join(folders)}, first {without[0]}"
        )
    splits, notes = _splits(people)
    return Capture(root, "zju_mocap", splits, body=of_one_clip(body), warnings=(*warnings, *notes))


def _annotated_shots(path: Path) -> list[tuple[int, FrameEntry]]:
    fields = read_pickled_array(inside(path))
    cams = {
        key: _items(f"{path}, cams", entry(path, fields, "cams"), key)
        for key in ("K", "D", "R", "T")
    }
    counts = {key: len(values) for key, values in cams.items()}
    if len(set(counts.values())) > 1 or not counts["K"]:
        raise DyngsError(
            f"{path}: 'cams' must have one K, D, R and T per camera, got {counts}; export it again"
        )
    calibrations = []
    for camera, (k, d, r, t) in enumerate(zip(*cams.values(), strict=True)):
        where = f"{path}, camera {camera}"
        pose = np.eye(4)
        pose[:3, :3] = numbers_of(f"{where}: 'R'", r, (3, 3))
        pose[:3, 3] = numbers_of(f"{where}: 'T'", t, (3,)) / 1000
        calibrations.append(_calibration(where, k, d, pose))
    shots = []
    for index, own in enumerate(_items(path, fields, "ims")):
        files = _items(f"{path}, ims {index}", own, "ims")
        if len(files) != len(calibrations) or not all(isinstance(file, str) for file in files):
            raise DyngsError(
                f"{path}, ims {index}: must name one image for each of the {len(calibrations)} cameras, got "
                f"{len(files)}; export it again"
            )
        frame = _frame_number(path, str(files[0]))
        for camera, (file, calibration) in enumerate(zip(files, calibrations, strict=True)):
            fields_of = calibration | {"file_path": str(file), "camera": camera, "frame": frame}
            shots.append((frame, FrameEntry(f"{path}, camera {camera}", fields_of)))
    if not shots:
        raise DyngsError(f"{path}: 'ims' lists no images; export it again")
    return shots


def _single_shots(path: Path) -> list[tuple[int, FrameEntry]]:
    shots = []
    for name, own in sorted(_by_name(path).items()):
        where = f"{path}, {name}"
        pose = numbers_of(f"{where}: 'extrinsics'", entry(where, own, "extrinsics"), (4, 4))
        lens = own.get("distortions", np.zeros(5))
        calibration = _calibration(where, entry(where, own, "intrinsics"), lens, pose)
        number = _frame_number(path, name)
        fields = calibration | {"file_path": f"images/{name}", "camera": 0, "frame": number}
        shots.append((number, FrameEntry(where, fields)))
    return shots


def _params_per_file(root: Path, frames: Iterable[int]) -> tuple[Path, BodyFrames]:
    """Return the folder of parameters and the parameters, read from one file per frame."""
    folder = next(
        (root / name for name in ("new_params", "params") if (root / name).is_dir()),
        root / "new_params",
    )
    numbers = sorted(frames)
    missing = [f"{number}.npy" for number in numbers if not (folder / f"{number}.npy").is_file()]
    if missing:
        raise DyngsError(
            f"{folder}: no body parameters for {len(missing)} of {len(numbers)} frames ({first_few(missing)}); restore "
            f"these or remove the frames from {ANNOTATIONS}"
        )
    paths = [folder / f"{number}.npy" for number in numbers]
    files = [(str(path), read_pickled_array(inside(path))) for path in paths]
    return folder, _body(folder, numbers, files, _column(files, "shapes"))


def _mesh_infos(path: Path) -> BodyFrames:
    """Body parameters of ``mesh_infos.pkl``: shape coefficients if it has any, and the fitted
    body's pelvis."""
    by_name = _by_name(path)
    infos = [(f"{path}, {name}", own) for name, own in by_name.items()]
    key = next((key for key in ("betas", "shapes") if all(key in own for _, own in infos)), None)
    betas = np.zeros(10) if key is None else _column(infos, key)
    body = _body(path, [_frame_number(path, name) for name in by_name], infos, betas)
    return replace(
        body, pelvis=np.mean(_column(infos, "tpose_joints", 3 * _NUM_JOINTS), axis=0)[:3]
    )


def _body(
    path: Path, numbers: list[int], rows: Sequence[tuple[str, object]], betas: object
) -> BodyFrames:
    poses = _column(rows, "poses")
    trans = _column(rows, "Th", 3)
    turns = _column(rows, "Rh", 3)
    return body_frames(path, numbers, poses, trans, betas, turns=turns)


def _column(
    rows: Iterable[tuple[str, object]], key: str, width: int | None = None
) -> list[np.ndarray]:
    """Finite numbers at ``key`` of each of the named dictionaries, ``width`` of them unless that is
    None."""
    shape = None if width is None else (width,)
    return [numbers_of(f"{where}: '{key}'", entry(where, own, key), shape) for where, own in rows]


def _calibration(
    where: str, intrinsics: object, lens: object, cam_from_world: np.ndarray
) -> dict[str, object]:
    k = numbers_of(f"{where}: the intrinsics", intrinsics, (3, 3))
    values = numbers_of(f"{where}: the distortion", lens, None).tolist()
    if len(values) not in (4, 5, 8):
        raise DyngsError(
            f"{where}: the distortion must have 4, 5 or 8 coefficients, got {len(values)}; export it again"
        )
    pose, _ = checked_pose(cam_from_world, where)
    return {
        "fl_x": float(k[0, 0]),
        "fl_y": float(k[1, 1]),
        "cx": float(k[0, 2]) + 0.5,
        "cy": float(k[1, 2]) + 0.5,
        "camera_model": "FULL_OPENCV" if len(values) == 8 else "OPENCV",
        **dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), values, strict=False)),
        "transform_matrix": opengl_from_cam(pose).tolist(),
    }


def _splits(views: Sequence[View]) -> tuple[Splits, list[str]]:
    if len({view.camera_id for view in views}) < MIN_CAMERAS_TO_HOLD_OUT:
        return {"train": tuple(views)}, []
    return {
        "train": tuple(view for view in views if view.camera_id != 0),
        "test": tuple(view for view in views if view.camera_id == 0),
    }, [FIRST_HELD_OUT]


def _mask(root: Path, file: str, folders: Sequence[str]) -> Path | None:
    """Find the mask ``FOLDER/a/b.png`` of ``a/b.jpg`` or ``images/a/b.jpg``, in the first folder
    that has it."""
    image = PurePosixPath(file.replace("\\", "/"))
    name = image.name if not image.suffix else image.with_suffix("").name
    below = [image.parent / f"{name}.png"]
    if image.parts[0] == "images":
        below.append(PurePosixPath(*below[0].parts[1:]))
    candidates = (root / folder / path for folder in folders for path in below)
    return next((path for path in candidates if path.is_file()), None)


def _frame_number(path: Path, name: str) -> int:
    """Frame number of ``000123.jpg``, ``frame_000123`` or ``Camera
    (1)_0123_2019-08-23_16.592.jpg``."""
    stem = PurePosixPath(name.replace("\\", "/")).name
    found = re.search(r"\)_(\d{1,15})(?!\d)", stem) or re.search(
        r"(?<!\d)(\d{1,15})(?:\.\w+)?$", stem
    )
    if not found:
        raise DyngsError(
            f"{path}: no frame number in the name {name!r:.80}; call the image 000000.jpg or the like"
        )
    return int(found[1])


def _by_name(path: Path) -> dict[str, dict[str, object]]:
    fields = read_pickle(inside(path))
    if (
        not isinstance(fields, dict)
        or not fields
        or not all(isinstance(own, dict) for own in fields.values())
    ):
        raise DyngsError(
            f"{path}: must be a dictionary from image names to parameters; export it again"
        )
    strange = [
        name for name in fields if not isinstance(name, str) or not re.fullmatch(r"[\w-]+", name)
    ]
    if strange:
        raise DyngsError(f"{path}: {strange[0]!r:.80} is no name of an image; export it again")
    return fields


def _items(where: object, fields: object, key: str) -> list[object]:
    value = entry(where, fields, key)
    if not isinstance(value, (list, tuple, np.ndarray)) or (
        isinstance(value, np.ndarray) and not value.ndim
    ):
        raise DyngsError(f"{where}: '{key}' must be a list; export it again")
    return list(value)


FORMAT = CaptureFormat(
    "zju_mocap",
    f"{ANNOTATIONS}, or {CAMERAS} and {MESHES}",
    lambda root: (
        (root / ANNOTATIONS).is_file()
        or ((root / CAMERAS).is_file() and (root / "images").is_dir())
    ),
    read_zju_mocap,
)
