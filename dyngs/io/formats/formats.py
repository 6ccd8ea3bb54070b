"""One reader and one writer for all files of Gaussians; the suffix names the format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, require_regular_file, wrap_read_errors
from dyngs.io.formats import ply
from dyngs.io.formats.antimatter import read_antimatter, write_antimatter
from dyngs.io.formats.checkpoint import read_checkpoint
from dyngs.io.formats.gltf import read_gltf, write_gltf
from dyngs.io.formats.ply import read_ply, write_ply
from dyngs.io.formats.similarity import (
    AXES,
    IDENTITY,
    Similarity,
    parse_axis,
    rotation_between,
)
from dyngs.io.formats.sog import read_sog, write_sog
from dyngs.io.formats.splat_file import (
    Nonfinite,
    SplatFile,
    make_renderable,
    move_to_origin,
    offset_notes,
    require_writable,
    unit_rotations,
    with_sh_degree,
)
from dyngs.io.formats.spz import read_spz, write_spz
from dyngs.io.formats.usd import read_usd, write_usd
from dyngs.io.write import atomic_file


@dataclass(frozen=True)
class Format:
    """A file format of Gaussians."""

    name: str  # as ``--format`` takes it
    suffixes: tuple[str, ...]  # of its files, lower case; the first one is written
    up: str  # axis that viewers of these files take for up
    max_degree: int  # largest degree of the harmonics that it holds
    read: Callable[[Path], SplatFile]
    write: Callable[[Path, SplatFile], None] | None
    stores_render_mode: bool = True  # whether it can say that the scene is antialiased
    stores_comments: bool = True  # whether its files say how they were turned and edited


FORMATS = (
    Format("compressed-ply", (".compressed.ply",), "-y", 3, read_ply, ply.write_compressed),
    Format("ply", (".ply",), "-y", 4, read_ply, write_ply),
    Format("spz", (".spz",), "y", 3, read_spz, write_spz, True, False),
    Format("splat", (".splat",), "-y", 0, read_antimatter, write_antimatter, False, False),
    Format("sog", (".sog",), "-y", 3, read_sog, write_sog),
    Format("glb", (".glb",), "y", 3, read_gltf, write_gltf, False),
    Format("usd", (".usdc", ".usd", ".usda"), "y", 4, read_usd, write_usd, False),
)
"""All formats; a suffix that ends another one stands after it."""
CHECKPOINT = Format("checkpoint", (".ckpt", ".pt"), "z", 4, read_checkpoint, None, False, False)
"""Read, never written."""
SOG_INDEX = "lod-meta.json"  # of a .sog in levels of detail


@dataclass(frozen=True)
class WrittenFile:
    """A file that was written."""

    path: Path  # of it
    splat: SplatFile  # what is read from it, but for what the format rounded
    notes: tuple[str, ...] = ()  # a line about each thing that the format could not hold


def format_for_path(path: Path) -> Format:
    """Return the format that the suffix of ``path`` names. Raises DyngsError: none does; names all
    of them."""
    found = find_format(path)
    if found is None:
        raise DyngsError(f"{path}: unknown file type; use one of {all_suffixes()}")
    return found


def find_format(path: Path) -> Format | None:
    """Return the format that the suffix of ``path`` names, None if none does."""
    name = path.name.lower()
    for candidate in FORMATS:
        if name.endswith(candidate.suffixes) and name not in candidate.suffixes:
            return candidate
    return None


def format_to_read(path: Path) -> Format | None:
    """Return the format that a file is read as, also a checkpoint; None if it is none, or a
    folder."""
    if path.is_dir():
        return None
    return CHECKPOINT if path.suffix.lower() in CHECKPOINT.suffixes else find_format(path)


def format_by_name(name: str) -> Format:
    """Return the format called ``name``. Raises DyngsError if there is none."""
    known = {candidate.name: candidate for candidate in FORMATS}
    if name not in known:
        raise DyngsError(f"unknown format {name!r:.30}; use one of {', '.join(known)}")
    return known[name]


def all_suffixes() -> str:
    """Return the suffixes of all formats, for messages."""
    return ", ".join(suffix for found in FORMATS for suffix in found.suffixes)


def read_splats(path: Path | str, *, nonfinite: Nonfinite = "error") -> SplatFile:
    """Read a file of Gaussians; its suffix names the format.

    ``nonfinite``: "skip" leaves out Gaussians with NaN or Inf, with a note, "error" refuses the
    file. Opacities of exactly 0 or 1 and sizes of 0 become finite. Raises DyngsError:
    an unknown suffix, or not such a file, cut off, empty or non-finite; nothing large is allocated
    before the header has been compared with the size of the file.
    """
    path = Path(path)
    own = format_to_read(path) or format_for_path(path)
    if not path.exists():
        raise DyngsError(f"{path}: no such file")
    require_regular_file(path)
    with wrap_read_errors(path):
        splat = own.read(path)
        if splat.up is None:
            splat = replace(splat, up=own.up)
        return make_renderable(move_to_origin(splat), path, nonfinite)


def write_splats(
    path: Path | str, splat: SplatFile, *, sh_degree: int | None = None
) -> WrittenFile:
    """Write a file of Gaussians, into which any 3D filter is fused, atomically; its suffix names
    the format.

    ``sh_degree``: SH degree of the file; higher coefficients are omitted, missing ones are zero;
    None: up to the limit of the format. Raises DyngsError: an unknown suffix, no Gaussians,
    non-finite values, or a degree that the format does not support.
    """
    path = Path(path)
    own = format_for_path(path)
    whole, notes = limit_to_format(path, own, splat, sh_degree)
    with atomic_file(path) as temporary:
        assert own.write is not None
        try:
            own.write(temporary, whole)
        except DyngsError as error:
            reason = str(error).removeprefix(f"{temporary}: ")
            raise DyngsError(f"{path}: not written: {reason}") from error
    return WrittenFile(path, whole, notes)


def limit_to_format(
    path: Path, own: Format, splat: SplatFile, sh_degree: int | None
) -> tuple[SplatFile, tuple[str, ...]]:
    """Return what a format can hold of a scene, on the CPU, and a line about each thing that it
    cannot.

    ``path``: for messages. ``sh_degree`` and errors: as of ``write_splats``.
    """
    gaussians = splat.gaussians.detach().to(device="cpu", dtype=torch.float32)
    notes = []
    require_writable(path, gaussians)
    if sh_degree is not None and sh_degree > own.max_degree:
        raise DyngsError(
            f"{path}: SH degree {sh_degree} is not supported; {own.name} stores at most degree "
            f"{own.max_degree}"
        )
    degree = min(gaussians.sh_degree, own.max_degree) if sh_degree is None else sh_degree
    if degree < gaussians.sh_degree and bool(gaussians.sh[:, (degree + 1) ** 2 :].any()):
        why = f"{own.name} stores no more" if sh_degree is None else "as requested"
        notes.append(f"SH coefficients above degree {degree} are dropped: {why}")
    if splat.mode is RasterizeMode.ANTIALIASED and not own.stores_render_mode:
        notes.append(
            f"{own.name} cannot store that the scene is antialiased; viewers draw thin parts too "
            "thick"
        )
    notes += offset_notes(
        splat, "stored in the file" if own.stores_comments else f"{own.name} cannot store it"
    )
    if splat.edited != IDENTITY and not own.stores_comments:
        notes.append(f"{own.name} cannot store the edits, so they cannot be undone")
    gaussians = with_sh_degree(gaussians.replace(quats=unit_rotations(gaussians.quats)), degree)
    return replace(splat, gaussians=gaussians), tuple(notes)


def orient_to_axis(splat: SplatFile, up: str | None, path: Path) -> SplatFile:
    """Return the contents turned so that what points up in them points along the axis ``up`` of a
    file.

    ``splat``: unchanged where it does not say what points up. ``up``: axis such as "-y"; None: what
    viewers of the format of ``path`` take for up; "keep": nothing is turned.
    """
    if up == "keep" or splat.up is None:
        return splat
    wanted = format_for_path(path).up if up is None else up
    return rotate_file(splat, rotation_between(parse_axis(splat.up), parse_axis(wanted)), wanted)


def rotate_file(
    splat: SplatFile, turn: tuple[float, float, float, float], up: str | None
) -> SplatFile:
    """Return the contents turned by a quaternion wxyz about the origin, ``up`` being what then
    points up."""
    if splat.edited == IDENTITY:
        gaussians = Similarity(turn).gaussians(splat.gaussians)
        turned = Similarity(turn).after(Similarity(splat.turned)).turn
        return replace(splat, gaussians=gaussians, up=up, turned=turned)
    return transform_file(splat, Similarity(turn), up)


def transform_file(splat: SplatFile, how: Similarity, up: str | None) -> SplatFile:
    """Return the contents rotated, scaled and shifted, so that it can be undone; ``up`` is what
    then points up."""
    gaussians = how.gaussians(splat.gaussians)
    return replace(splat, gaussians=gaussians, up=up, edited=how.after(splat.edited))


def undo_transforms(splat: SplatFile) -> SplatFile:
    """Return the contents as they lay before all of ``moved_file``; up is known where it was an
    axis."""
    back = splat.edited.inverse()
    up = splat.up
    if up is not None:
        before = back.rotation @ parse_axis(up)
        up = next((name for name, axis in AXES.items() if before @ axis > 1 - 1e-6), None)
    return replace(splat, gaussians=back.gaussians(splat.gaussians), up=up, edited=IDENTITY)
