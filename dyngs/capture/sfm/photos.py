"""Photos for structure from motion: found below a folder, made readable, rotated upright, masks
next to them."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, format_count, wrap_read_errors
from dyngs.data.images.images import (
    END_MARKERS,
    SUFFIXES,
    ImageHeader,
    check_image,
    is_rotated_sideways,
    read_header,
    read_image,
    read_mask,
)
from dyngs.data.images.video import (
    DECODER_VERSION,
    UNSPECIFIED,
    VIDEO_SUFFIXES,
    ColourTags,
    to_srgb,
)
from dyngs.io.containment import check_inside, check_size
from dyngs.io.outputs import PHOTO_SUFFIXES
from dyngs.io.write import atomic_file, write_image

HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
"""What phones write; read by pillow-heif."""
_FOR_COLMAP = {"jpeg": ".jpg", "png": ".png", "tiff": ".tif", "bmp": ".bmp"}
"""Suffixes of the formats that COLMAP reads, by ``ImageHeader.format_name``."""
_SAMPLE_BYTES = 2**20


@dataclass(frozen=True)
class Photo:
    """An image ``name`` below ``images/`` with its header there; ``source``: the photo below its
    folder."""

    name: str
    header: ImageHeader
    source: str = ""


def list_photos(folder: Path) -> list[Path]:
    """Return all photos below the folder, sorted; hidden files and folders are left out."""
    return [path for path in _files_below(folder) if path.suffix.lower() in PHOTO_SUFFIXES]


def digest_files(source: Path, files: Sequence[Path] | None = None) -> str:
    """Return 16 hexadecimal digits of names, sizes and times of change of files, and of the
    beginnings of videos.

    Of a video, or of ``files`` of a folder, None: all photos below it.
    """
    digest = hashlib.sha256()
    for path in files or ([source] if source.is_file() else list_photos(source)):
        with wrap_read_errors(path):
            status = path.stat()
            digest.update(os.fsencode(path.relative_to(source.parent)))
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
            if path.suffix.lower() in VIDEO_SUFFIXES:
                digest.update(DECODER_VERSION)
                with path.open("rb") as file:
                    digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:16]


def gather_photos(source: Path, images: Path, out: Path) -> tuple[list[Photo], list[str]]:
    """Copy all photos below ``source`` to ``images``; return them, sorted by source, and lines on
    what is left out.

    Photos that lie on their side by their EXIF tag are copied as they are: the model's sizes say
    that they are to be rotated, and readers of ours do. Those that are upside down, mirrored or
    square cannot be told by their size: they are written upright, as PNG, and so are HEIC photos
    and the first frame of GIF files. Hidden files and those of ``out``, the capture that will be
    made, are left out. Raises DyngsError: a file is no
    image, truncated, too large, or lies outside the folder; pillow-heif is missing.
    """
    result = out.resolve()
    files = [file for file in _files_below(source) if result not in file.resolve().parents]
    taken = [file for file in files if file.suffix.lower() in PHOTO_SUFFIXES]
    heif = [file for file in taken if _is_heif(file)]
    if heif and find_spec("pillow_heif") is None:
        raise DyngsError(
            f"{source}: {len(heif)} HEIC photos, first {heif[0].name}, need the package "
            "pillow-heif: pip install 'dyngs[heic]', or convert them to JPEG"
        )
    headers = {photo: _checked(photo) for photo in taken}
    names = _stored_names(
        {photo.relative_to(source): _is_converted(photo, headers[photo]) for photo in taken}
    )
    photos = []
    conversions = set()
    for photo, header in headers.items():
        relative = photo.relative_to(source)
        target = images / names[relative]
        conversions.add(_store(photo, target, header))
        stored = (
            header if header is not None and target.suffix == photo.suffix else read_header(target)
        )
        photos.append(Photo(names[relative].as_posix(), stored, relative.as_posix()))
    notes = [f"HEIC photos: {conversion}" for conversion in sorted(conversions - {""})]
    left_out = len(files) - len(taken)
    if left_out:
        known = ", ".join(sorted(PHOTO_SUFFIXES))
        notes.append(f"{format_count(left_out, 'file')} skipped, not photos ({known})")
    return photos, notes


def copy_file(source: Path, target: Path) -> None:
    """Make ``target`` a copy of a file, atomically."""
    with atomic_file(target) as temporary:
        shutil.copyfile(source, temporary)


def prepare_colmap_images(
    photos: list[Photo], stored_in: Path, images: Path, masks: dict[str, Path]
) -> list[str]:
    """Write upright images under plain names into ``images`` for COLMAP, masks next to; return the
    names.

    COLMAP ignores the orientation of EXIF, and its lists of pairs cannot hold names with white
    space. The folder must not outlive the work, as files in it may be links to the photos.
    """
    names = []
    images.mkdir(exist_ok=True)
    for index, photo in enumerate(photos):
        stored = stored_in / photo.name
        lies = (
            is_rotated_sideways(photo.header.orientation)
            and photo.header.upright_size != photo.header.size
        )
        is_written = lies or photo.header.format_name not in _FOR_COLMAP
        name = f"{index:06d}" + (".png" if is_written else _FOR_COLMAP[photo.header.format_name])
        names.append(name)
        if is_written:
            write_image(images / name, read_image(stored, upright=True).numpy())
        else:
            try:
                os.link(stored, images / name)
            except OSError:
                shutil.copyfile(stored, images / name)
        mask = masks.get(photo.name)
        if mask is not None:
            target = images.with_name("masks") / f"{name}.png"
            write_image(
                target,
                np.where(read_mask(check_inside(mask)).numpy(), 255, 0).astype(np.uint8)[..., None],
            )
    return names


def _files_below(folder: Path) -> list[Path]:
    return sorted(
        path for path in folder.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )  # fmt: skip


def _checked(photo: Path) -> ImageHeader | None:
    """Return the header of a photo that is complete; None for HEIC, which is checked when it is
    converted."""
    if _is_heif(photo):
        return None
    header = check_image(photo)
    if header.format_name not in END_MARKERS:
        read_image(photo)
    return header


def _is_heif(photo: Path) -> bool:
    """Whether the content of a photo is HEIC; JPEG may be named ``.heic``."""
    with wrap_read_errors(photo), check_inside(photo).open("rb") as file:
        begin = file.read(8)
    is_jpeg = begin.startswith(b"\xff\xd8")
    return begin[4:] == b"ftyp" or (photo.suffix.lower() in HEIF_SUFFIXES and not is_jpeg)


def _is_converted(photo: Path, header: ImageHeader | None) -> bool:
    if header is None or photo.suffix.lower() not in SUFFIXES:
        return True
    return header.orientation != 1 and header.upright_size == header.size


def _stored_names(converted: dict[Path, bool]) -> dict[Path, Path]:
    """Return where each photo is stored; no two differ in the suffix alone, because views are named
    without it, nor in upper and lower case, which are one file to Windows and macOS."""
    taken: set[str] = set()
    names = {}
    for name, is_png in sorted(converted.items(), key=lambda item: (item[1], item[0])):
        view = name.with_suffix("")
        count = 1
        while view.as_posix().casefold() in taken:
            view = name.with_name(name.name if count == 1 else f"{name.name}_{count}")
            count = count + 1
        taken.add(view.as_posix().casefold())
        names[name] = view.with_name(view.name + (".png" if is_png else name.suffix))
    return names


def _store(photo: Path, target: Path, header: ImageHeader | None) -> str:
    """Store a photo so that readers of ours show it upright; return how its colours were converted,
    else ""."""
    if header is None:
        return _convert_heif(photo, target)
    if not _is_converted(photo, header):
        copy_file(photo.resolve(), target)
    else:
        pixels = read_image(photo, upright=True).numpy()
        is_opaque = pixels.shape[2] == 4 and bool((pixels[..., 3] == 255).all())
        write_image(target, pixels[..., :3] if is_opaque else pixels)
    return ""


def _convert_heif(photo: Path, target: Path) -> str:
    import pillow_heif
    from PIL import Image

    heif: Any = pillow_heif
    with (
        wrap_read_errors(photo, "the image is damaged; copy or convert it again"),
        heif.HeifImageFile(str(photo)) as image,
    ):
        check_size(photo, *image.size)
        rgb = image.convert("RGB")
        exif = image.info.get("exif")
        profile = image.info.get("nclx_profile") or {}
    primaries = profile.get("color_primaries", UNSPECIFIED)
    tags = ColourTags(primaries, profile.get("transfer_characteristics", UNSPECIFIED))
    if tags.conversion:
        rgb = Image.fromarray(to_srgb(np.asarray(rgb) * np.uint16(257), tags))
    with atomic_file(target) as temporary:
        rgb.save(temporary, exif=exif or b"", compress_level=1)
    return tags.conversion
