"""Reader for PeopleSnapshot: a video of a rotating person, ``camera.pkl``, masks and poses in
HDF5."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import build_body_frames, share_body_across_splits
from dyngs.data.capture import BodyFrames, Capture, CaptureFormat, Silhouette
from dyngs.data.geometry import to_opengl_pose
from dyngs.data.images.images import list_files
from dyngs.data.images.maps import MASKS
from dyngs.data.images.video import VIDEO_SUFFIXES
from dyngs.data.readers.camera_folders import open_camera, sequence_views, video_fps
from dyngs.io.containment import check_inside
from dyngs.io.fields import parse_numbers, require_key
from dyngs.io.numpy_files import hdf5_length, read_hdf5
from dyngs.io.pickles import read_pickle

CAMERA = "camera.pkl"
MASK_FILE = "masks.hdf5"
POSE_FILE = "reconstructed_poses.hdf5"


def read_people_snapshot(root: Path) -> Capture:
    """Read the capture of one fixed camera (Alldieck et al. 2018); frame n is row n of masks and
    poses.

    ``camera.pkl``: camera_f, camera_c (2,) px, camera_k (5,) OpenCV, camera_rt axis-angle and
    camera_t of cam_from_world, width, height. ``masks.hdf5``: masks (F, H, W), 0 is background.
    ``reconstructed_poses.hdf5``: SMPL pose (F, 72), trans (F, 3), betas (10,), in metres. Frames
    without a mask or parameters are skipped. Raises DyngsError if h5py is not installed, or a file
    is missing, damaged or inconsistent.
    """
    camera = open_camera((video := _video(root)).stem, video)
    body = _body(root / POSE_FILE)
    usable = set(body.frames) & set(range(hdf5_length(root / MASK_FILE, MASKS)))
    images = {number: path for number, path in camera.images.items() if number in usable}
    if not images:
        raise DyngsError(
            f"{root}: no frame of {video.name} has both a mask and body parameters; restore the "
            "HDF5 files"
        )
    views, warnings = sequence_views(
        root / CAMERA, [replace(camera, images=images)], {camera.name: _calibration(root / CAMERA)}
    )
    people = tuple(
        replace(view, silhouette=Silhouette(root / MASK_FILE, "nonzero", number))
        for view, number in zip(views[camera.name], sorted(images), strict=True)
    )
    lost = len(camera.images) - len(images)
    if lost:
        warnings.append(
            f"{video.name}: {lost} of {len(camera.images)} frames have no mask or no pose and "
            "are skipped"
        )
    own = share_body_across_splits(body)
    fps = video_fps([camera])
    lines = tuple(warnings)
    return Capture(root, "people_snapshot", {"train": people}, fps=fps, body=own, warnings=lines)


def _video(root: Path) -> Path:
    """Return the only video of the folder, or the one named after the folder."""
    found = list_files(root, VIDEO_SUFFIXES)
    named = [path for path in found if path.stem == root.resolve().name] or found
    if len(named) != 1:
        what = f"{len(found)} videos" if found else "no video"
        raise DyngsError(f"{root}: found {what}; keep one, named {root.resolve().name}.mp4")
    return named[0]


def _calibration(path: Path) -> dict[str, object]:
    from scipy.spatial.transform import Rotation  # late: other captures need none of scipy

    fields = read_pickle(check_inside(path))

    def numbers(key: str, count: int) -> np.ndarray:
        return parse_numbers(f"{path}: '{key}'", require_key(path, fields, key), (count,))

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(numbers("camera_rt", 3)).as_matrix()
    pose[:3, 3] = numbers("camera_t", 3)
    counts = {"camera_f": 2, "camera_c": 2, "camera_k": 5, "width": 1, "height": 1}
    values = [x for key, count in counts.items() for x in numbers(key, count).tolist()]
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "w", "h")
    own = dict(zip(keys, values, strict=True))
    return own | {"transform_matrix": to_opengl_pose(pose).tolist()}


def _body(path: Path) -> BodyFrames:
    """Return the body parameters of the fitted frames; rows of zeros were not fitted."""
    poses, trans, betas = (read_hdf5(path, key) for key in ("pose", "trans", "betas"))
    if len(poses) != len(trans):
        raise DyngsError(
            f"{path}: 'pose' has {len(poses)} rows but 'trans' {len(trans)}; export it again"
        )
    fitted = np.flatnonzero([x.any() or y.any() for x, y in zip(poses, trans, strict=True)])
    return build_body_frames(path, fitted.tolist(), poses[fitted], trans[fitted], betas)


FORMAT = CaptureFormat(
    "people_snapshot",
    f"{CAMERA}, {MASK_FILE}, {POSE_FILE}",
    lambda root: (
        (root / CAMERA).is_file()
        and any((root / name).is_file() for name in (MASK_FILE, POSE_FILE))
    ),
    read_people_snapshot,
)
