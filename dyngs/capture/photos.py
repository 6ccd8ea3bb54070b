"""Photos for structure from motion: found below a folder, turned upright, masks beside them."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngs.data.images.exif import is_lying
from dyngs.data.images.images import ImageHeader, read_header, read_image, read_mask
from dyngs.data.images.video import VIDEO_SUFFIXES
from dyngs.errors import reading
from dyngs.files.containment import check_size, inside
from dyngs.files.write import write_image
from dyngs.files.wrong_place import PHOTO_SUFFIXES

_SAMPLE_BYTES = 2**20


@dataclass(frozen=True)
class Photo:
    """An image of the capture that is made.

    Attributes:
        name: path below ``images/``.
        header: size and tags as stored there.
    """

    name: str
    header: ImageHeader


def photos_below(folder: Path) -> list[Path]:
    """Return all photos below the folder, sorted; hidden files and folders are left out."""
    return sorted(
        path for path in folder.rglob("*")
        if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )  # fmt: skip


def digest_of(source: Path, files: Sequence[Path] | None = None) -> str:
    """Return 16 hexadecimal digits of names, sizes and times of change of files, and of the beginnings of videos.

    Args:
        source: a video, or a folder.
        files: of that folder; None: all photos below it.
    """
    digest = hashlib.sha256()
    for path in files or ([source] if source.is_file() else photos_below(source)):
        with reading(path):
            status = path.stat()
            digest.update(os.fsencode(path.relative_to(source.parent)))
            digest.update(f"{status.st_size} {status.st_mtime_ns}".encode())
            if path.suffix.lower() in VIDEO_SUFFIXES:
                with path.open("rb") as file:
                    digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()[:16]


def gather_photos(source: Path, images: Path, out: Path) -> list[Photo]:
    """Copy (hard-link where possible) all photos below ``source`` to ``images``, sorted by name.

    Photos that lie on their side by their EXIF tag are linked as they are: the model's sizes say that they are to be
    turned, and readers of ours do. Those that are upside down, mirrored or square cannot be told by their size: they
    are written upright, as PNG.

    Args:
        source: a folder; hidden files, and those of ``out``, are left out.
        images: a folder, made if there are photos.
        out: the capture that will be made.

    Raises:
        DyngsError: a file is no image, too large, or lies outside the folder.
    """
    result = out.resolve()
    taken = [photo for photo in photos_below(source) if result not in photo.resolve().parents]
    names = {photo.relative_to(source) for photo in taken}
    photos = []
    for photo in taken:
        header = read_header(inside(photo))
        check_size(photo, header.width, header.height, header.channels)
        name = photo.relative_to(source)
        target = images / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if header.tags.orientation != 1 and header.upright_size == header.size:
            png = name.with_suffix(".png")
            name = name.with_name(name.name + ".png") if png in names else png
            write_image(images / name, read_image(photo, upright=True).numpy())
        elif not target.exists():
            link_or_copy(photo.resolve(), target)
        photos.append(Photo(name.as_posix(), header))
    return photos


def link_or_copy(source: Path, target: Path) -> None:
    """Make ``target`` a hard link of a file, or a copy where links are not possible."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def lay_out(photos: list[Photo], stored_in: Path, images: Path, masks: dict[str, Path]) -> list[str]:
    """Write upright images under plain names into ``images`` for COLMAP, masks beside; return the names.

    COLMAP ignores the orientation of EXIF, and its lists of pairs cannot hold names with white space.

    Args:
        photos: in order.
        stored_in: folder of theirs.
        images: a folder; images that are there already are left.
        masks: of photos, by name; white = keep.
    """
    names = []
    images.mkdir(exist_ok=True)
    for index, photo in enumerate(photos):
        stored = stored_in / photo.name
        lies = is_lying(photo.header.tags.orientation) and photo.header.upright_size != photo.header.size
        name = f"{index:06d}" + (".png" if lies else stored.suffix.lower())
        names.append(name)
        if not (images / name).exists():
            if lies:
                write_image(images / name, read_image(stored, upright=True).numpy())
            else:
                link_or_copy(stored, images / name)
        mask = masks.get(photo.name)
        if mask is not None:
            target = images.with_name("masks") / f"{name}.png"
            write_image(target, np.where(read_mask(inside(mask)).numpy(), 255, 0).astype(np.uint8)[..., None])
    return names
