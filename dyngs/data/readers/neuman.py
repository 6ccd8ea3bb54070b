"""Reader for NeuMan: a COLMAP model, masks, and a body fitted to each image and aligned to the
model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.body_frames import build_body_frames, parse_frame_number, share_body_across_splits
from dyngs.data.capture import BodyFrames, Capture, CaptureFormat, Silhouette, Splits, View
from dyngs.data.geometry import validate_pose
from dyngs.data.readers.colmap import is_colmap, read_colmap
from dyngs.data.readers.transforms import SPLITS
from dyngs.io.containment import check_inside
from dyngs.io.fields import first_few, parse_numbers, read_limited, require_key
from dyngs.io.numpy_files import read_npz
from dyngs.io.pickles import read_pickle, read_pickled_array

ALIGNED = "4d_humans/smpl_optimized_aligned_scale.npz"
ALIGNMENTS = "alignments.npy"
FITS = ("smpl_output_optimized.pkl", "smpl_output_romp.pkl")


def read_neuman(root: Path) -> Capture:
    """Read the capture of one moving camera (Jiang et al. 2022), in the world and unit of its
    COLMAP model.

    Body parameters have one row per registered image, in order of names:
    ``4d_humans/smpl_optimized_aligned_scale.npz`` (global_orient, body_pose, betas, transl,
    scale), else ``smpl_output_optimized.pkl`` or ``smpl_output_romp.pkl`` (pose, betas of one
    person) with ``alignments.npy`` (image name to a (4, 3) matrix M, ``world = [v 1] M``). Masks
    in ``segmentations`` have the names of the images and are black on the person. Splits are read
    from ``{train,val,test}_split.txt``, if present.
    """
    capture = read_colmap(root)
    posed = sorted(capture.splits["train"], key=lambda view: view.image_path.name)
    names = [view.image_path.name for view in posed]
    numbers = [parse_frame_number(root / "images", name) for name in names]
    first = min(numbers, default=0)
    last = max(numbers, default=0)
    people: dict[str, View] = {}
    for view, number in zip(posed, numbers, strict=True):
        mask = root / "segmentations" / view.image_path.name
        people[view.image_path.name] = replace(
            view,
            camera_id=0,
            frame=number,
            time=(number - first) / max(last - first, 1),
            silhouette=Silhouette(mask, "black") if mask.is_file() else None,
        )
    if (root / ALIGNED).is_file():
        path = root / ALIGNED
        found = read_npz(path, ("global_orient", "body_pose", "betas", "transl", "scale"))
        with wrap_read_errors(path, "it must hold a row for each posed image"):
            parts = [found[key].reshape(len(names), -1) for key in ("global_orient", "body_pose")]
            poses = np.concatenate(parts, axis=1)
        body = build_body_frames(
            path, numbers, poses, found["transl"], found["betas"], found["scale"]
        )
    else:
        body = _fitted(root, names, numbers)
    without = [name for name, view in people.items() if view.silhouette is None]
    notes = []
    if without:
        notes = [f"{len(without)} images have no mask in segmentations, first {without[0]}"]
    splits, more = _splits(root, people)
    warnings = (*capture.warnings, *notes, *more)
    return capture.replace(
        format="neuman", splits=splits, body=share_body_across_splits(body), warnings=warnings
    )


def _fitted(root: Path, names: list[str], numbers: list[int]) -> BodyFrames:
    """Return the SMPL fits mapped to the world by the similarity transform of each image."""
    from scipy.spatial.transform import Rotation  # late: other captures need none of scipy

    path = next((root / name for name in FITS if (root / name).is_file()), root / FITS[0])
    with wrap_read_errors(path, "it must hold the body parameters of one person"):
        fits: Any = read_pickle(check_inside(path))
        (fit,) = fits.values()
        poses = fit["pose"]
        betas = fit["betas"]
    alignments = read_pickled_array(check_inside(root / ALIGNMENTS))
    scales = []
    turns = []
    trans = []
    for name in names:
        where = f"{root / ALIGNMENTS}, {name}"
        matrix = parse_numbers(where, require_key(root / ALIGNMENTS, alignments, name), (4, 3)).T
        scale = float(np.cbrt(np.linalg.det(matrix[:, :3])))
        if scale <= 0:
            raise DyngsError(
                f"{where}: the alignment is not a similarity transform; export it again"
            )
        rigid = np.concatenate([matrix[:, :3] / scale, matrix[:, 3:]], axis=1)
        pose, _ = validate_pose(rigid, where)
        scales.append(scale)
        turns.append(Rotation.from_matrix(pose[:3, :3]).as_rotvec())
        trans.append(pose[:3, 3])
    return build_body_frames(path, numbers, poses, trans, betas, np.array(scales), turns)


def _splits(root: Path, people: dict[str, View]) -> tuple[Splits, list[str]]:
    """Return splits by the lists of names (all views for training without lists), and warnings."""
    splits: Splits = {}
    unposed: list[str] = []
    for split in SPLITS:
        path = root / f"{split}_split.txt"
        if not path.is_file():
            continue
        with wrap_read_errors(path, "it must list one image name per line"):
            listed = list(dict.fromkeys(read_limited(check_inside(path)).decode().split()))
        unposed += [name for name in listed if name not in people]
        splits[split] = tuple(people[name] for name in listed if name in people)
    if "train" not in splits:
        held_out = {view.name for views in splits.values() for view in views}
        splits["train"] = tuple(view for view in people.values() if view.name not in held_out)
    if not unposed:
        return splits, []
    return splits, [
        f"{len(unposed)} images of the splits have no pose and are skipped: {first_few(unposed)}"
    ]


FORMAT = CaptureFormat(
    "neuman",
    "a COLMAP model and alignments.npy or 4d_humans",
    lambda root: (
        is_colmap(root) and any((root / name).is_file() for name in (ALIGNED, ALIGNMENTS, *FITS))
    ),
    read_neuman,
    extends="colmap",
)
