"""Mutation of cases: choice of a file, and of the mutation for its format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from random import Random

from fuzz.arrays import npy_changed, npz_changed
from fuzz.blobs import TEXTS, bytes_changed, text_changed
from fuzz.case import Case
from fuzz.images import exr_changed, jpeg_changed, png_changed, video_changed
from fuzz.opcodes import pickle_changed
from fuzz.scenes import (
    bvh_changed,
    colmap_changed,
    dyngs_changed,
    glb_changed,
    hdf5_changed,
    ply_changed,
    safetensors_changed,
)
from fuzz.splats import sog_changed, spz_changed
from fuzz.trees import json_changed, override_changed, yaml_changed

Change = Callable[[bytes, Random], bytes]

CHANGES: Mapping[str, Change] = {
    ".json": json_changed,
    ".gltf": json_changed,
    ".yaml": yaml_changed,
    ".overrides": override_changed,
    ".txt": text_changed,
    ".obj": text_changed,
    ".jsonl": text_changed,
    ".npy": npy_changed,
    ".npz": npz_changed,
    ".pkl": pickle_changed,
    ".png": png_changed,
    ".jpg": jpeg_changed,
    ".exr": exr_changed,
    ".mp4": video_changed,
    ".bin": colmap_changed,
    ".ply": ply_changed,
    ".spz": spz_changed,
    ".sog": sog_changed,
    ".bvh": bvh_changed,
    ".glb": glb_changed,
    ".hdf5": hdf5_changed,
    ".safetensors": safetensors_changed,
    ".dyngs": dyngs_changed,
}
"""Mutations of files by suffix."""

_IMAGES = (".png", ".jpg", ".exr", ".tif", ".bmp", ".webp")
_LINKS = (
    "..",
    "../precious",
    ".",
    "../precious/keep.txt",
    "none",
    "/dev/zero",
    "/dev/null",
    "../capture",
)


def changed_case(seeds: Mapping[str, Case], rng: Random) -> Case:
    """Return one of the seeds after one to three mutations."""
    case = seeds[rng.choice(sorted(seeds))]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        is_alone = len(case.files) == 1
        case = (
            _file_changed(case, rng)
            if is_alone or rng.random() < 0.88
            else _folder_changed(case, rng)
        )
    return case


def _file_changed(case: Case, rng: Random) -> Case:
    name = _chosen(case, rng)
    if name is None:
        return case
    suffix = "." + name.rpartition(".")[2].lower()
    change = bytes_changed if rng.random() < 0.05 else CHANGES.get(suffix, bytes_changed)
    return case.changed(
        f"{change.__name__} {name}", {**case.files, name: change(case.files[name], rng)}
    )


def _chosen(case: Case, rng: Random) -> str | None:
    """Choose a file; all images together count as one, so that files that describe them are mutated
    more often."""
    images = [name for name in sorted(case.files) if name.endswith(_IMAGES)]
    others = [name for name in sorted(case.files) if not name.endswith(_IMAGES)]
    choices = others + ([rng.choice(images)] if images else [])
    return rng.choice(choices) if choices else None


def _folder_changed(case: Case, rng: Random) -> Case:
    """Remove, rename, replace_scene or empty a file, or replace it by a folder or a link."""
    name = rng.choice(sorted(case.files))
    other = rng.choice(sorted(case.files))
    files = dict(case.files)
    change = rng.randrange(7)
    if change == 0:
        del files[name]
        return case.changed(f"without {name}", files)
    if change == 1:
        folder, _, base = name.rpartition("/")
        new = f"{folder}/{rng.choice(TEXTS)}{base}".lstrip("/")
        return (
            case
            if ".." in new
            else case.changed(f"renamed {name}", {**files, new: files.pop(name)})
        )
    if change == 2:
        files[name], files[other] = files[other], files[name]
        return case.changed(f"exchanged {name} and {other}", files)
    if change == 3:
        return case.changed(f"emptied {name}", {**files, name: b""})
    if change == 4:
        del files[name]
        return case.changed(f"{name} is a folder", {**files, f"{name}/x.png": b"x"})
    place = rng.choice((name, name.rpartition("/")[0] or name, ".dyngs_frames", "images", "masks"))
    return case.changed(f"link {place}", files, {**case.links, place: rng.choice(_LINKS)})
