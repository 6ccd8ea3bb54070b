"""PlayCanvas' ``.sog``: a zip of lossless WebP images with a pixel per Gaussian, and ``meta.json``;
version 2.

Positions take 16 bits per axis on a logarithmic scale, rotations 26 bits, scales and colours index
a table of 256 values, and harmonics above degree 0 a palette of up to 65,536 rows of such indices.
Axes are those of the .ply. The same files may lie in a folder, unpacked.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveInt, ValidationError

from dyngs.core.conventions import RasterizeMode, num_sh_terms
from dyngs.core.errors import DyngsError, require_regular
from dyngs.core.gaussians import Gaussians, morton_order
from dyngs.io.formats.formats import SOG_META
from dyngs.io.formats.packing import (
    codebook,
    largest_and_others,
    logit,
    nearest_entries,
    palette,
    with_largest,
)
from dyngs.io.formats.splat_file import (
    MOST_GAUSSIANS,
    SplatFile,
    described,
    header_comments,
    stored_comments,
)
from dyngs.io.limits import require_at_most

_PER_ROW = 64
_MOST_META_BYTES = 1 << 20
_MOST_PIXELS = 1 << 27
_MODE = 252  # alpha of a rotation: this plus the index of its largest entry
_HALF_ROOT = float(np.sqrt(0.5))

_Table = Annotated[tuple[FiniteFloat, ...], Field(min_length=256, max_length=256)]
_Three = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]
_One = Annotated[tuple[str, ...], Field(min_length=1, max_length=1)]
_Two = Annotated[tuple[str, ...], Field(min_length=2, max_length=2)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class _Means(_Part):
    mins: _Three
    maxs: _Three
    files: _Two


class _Coded(_Part):
    codebook: _Table
    files: _One


class _Rotations(_Part):
    files: _One


class _Rest(_Part):
    count: PositiveInt
    bands: Annotated[int, Field(ge=1, le=3)]
    codebook: _Table
    files: _Two


class _Asset(_Part):
    comments: object = None


class _Meta(_Part):
    version: int
    asset: _Asset = _Asset()
    count: PositiveInt
    antialias: bool = False
    means: _Means
    scales: _Coded
    quats: _Rotations
    sh0: _Coded
    shN: _Rest | None = None


_Members = Callable[[str, int, str], bytes]
"""Returns the bytes of a file of the given name, whose size is at most so many of what the last
argument says."""


def read_sog(path: Path) -> SplatFile:
    """Read a .sog of version 2, or the ``meta.json`` of an unpacked one.

    Raises DyngsError if it is damaged or asks for too much memory.
    """
    if path.name == SOG_META:
        return _read(path, _in_folder(path))
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(path, _in_archive(path, archive))
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise DyngsError(
            f"{path}: is no .sog or is cut off ({str(error)[:80]}); copy or export it again"
        ) from error


def write_sog(path: Path, splat: SplatFile) -> None:
    """Write a .sog of version 2, harmonics up to degree 3."""
    gaussians = splat.gaussians.select(
        torch.from_numpy(morton_order(splat.gaussians.means.numpy()))
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in sog_parts(replace(splat, gaussians=gaussians)):
            # without the time of day: equal scenes, equal bytes
            archive.writestr(zipfile.ZipInfo(name), data)


def sog_parts(splat: SplatFile) -> Iterator[tuple[str, bytes]]:
    """Yield the names and contents of the files that a .sog holds; Gaussians stay in their
    order."""
    gaussians = splat.gaussians
    n = len(gaussians)
    width = 4 * int(np.ceil(np.sqrt(n) / 4))
    height = int(np.ceil(n / width))
    images: dict[str, np.ndarray] = {}

    def draw(name: str, pixels: np.ndarray) -> str:
        whole = np.zeros((width * height, 4), np.uint8)
        whole[:, 3] = 255
        whole[:n, : pixels.shape[1]] = pixels
        images[name] = whole.reshape(height, width, 4)
        return name

    far = gaussians.means.double().numpy()
    far = np.sign(far) * np.log1p(np.abs(far))
    low = far.min(axis=0)
    high = far.max(axis=0)
    grid = np.round((far - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    means = [draw("means_l.webp", grid & 255), draw("means_u.webp", grid >> 8)]
    largest, others = largest_and_others(gaussians.quats.numpy())
    coded = np.concatenate(
        [np.round((others * _HALF_ROOT + 0.5) * 255), _MODE + largest[:, None]], axis=1
    )
    quats = draw("quats.webp", coded.astype(np.uint8))
    sizes = codebook(gaussians.log_scales.numpy().ravel())
    scales = draw("scales.webp", nearest_entries(sizes, gaussians.log_scales.numpy()))
    base = gaussians.sh[:, 0].numpy()
    colours = codebook(base.ravel())
    alpha = np.round(gaussians.opacities.numpy() * 255).astype(np.uint8)[:, None]
    sh0 = draw("sh0.webp", np.concatenate([nearest_entries(colours, base), alpha], axis=1))
    meta = {
        "version": 2,
        "asset": {"generator": "dyngs", "comments": header_comments(splat)},
        "count": n,
        "antialias": splat.mode is RasterizeMode.ANTIALIASED,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": means},
        "scales": {"codebook": sizes.tolist(), "files": [scales]},
        "quats": {"files": [quats]},
        "sh0": {"codebook": colours.tolist(), "files": [sh0]},
    }
    if gaussians.sh_degree:
        rows, labels = palette(gaussians.sh[:, 1:].flatten(1).numpy())
        values = codebook(rows.ravel())
        labelled = draw(
            "shN_labels.webp",
            np.stack([labels & 255, labels >> 8, 0 * labels], axis=1).astype(np.uint8),
        )
        images["shN_centroids.webp"] = _palette_image(nearest_entries(values, rows))
        files = ["shN_centroids.webp", labelled]
        meta["shN"] = {
            "count": len(rows),
            "bands": gaussians.sh_degree,
            "codebook": values.tolist(),
            "files": files,
        }
    yield SOG_META, json.dumps(meta).encode()
    for name, image in images.items():
        yield name, _encoded(image)


def _palette_image(indices: np.ndarray) -> np.ndarray:
    """Return the image (H, W, 4) of palette rows (P, 3 T): 64 rows side by side, T pixels each."""
    count = len(indices)
    terms = indices.shape[1] // 3
    whole = np.zeros((_PER_ROW * -(-count // _PER_ROW), terms, 4), np.uint8)
    whole[..., 3] = 255
    whole[:count, :, :3] = indices.reshape(count, terms, 3)
    return whole.reshape(-1, _PER_ROW * terms, 4)


def _encoded(image: np.ndarray) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image, "RGBA").save(
        out, "WEBP", lossless=True, exact=True, quality=75, method=4
    )
    return out.getvalue()


def _in_archive(path: Path, archive: zipfile.ZipFile) -> _Members:
    def member(name: str, most: int, what: str) -> bytes:
        try:
            info = archive.getinfo(name)
        except KeyError:
            raise DyngsError(
                f"{path}: has no {name:.60}, so it is no .sog; export it again"
            ) from None
        require_at_most(path, info.file_size, most, what)
        with archive.open(info) as file:
            return file.read(info.file_size)

    return member


def _in_folder(path: Path) -> _Members:
    def member(name: str, most: int, what: str) -> bytes:
        file = path.with_name(name) if Path(name).name == name and "\\" not in name else None
        if file is None or (file.exists() and file.resolve().parent != path.parent.resolve()):
            raise DyngsError(f"{path}: {name!r:.60} lies outside of its folder; put the file there")
        require_regular(file)
        if not file.is_file():
            raise DyngsError(f"{path}: {name:.60} is missing beside it; export it again")
        require_at_most(file, file.stat().st_size, most, what)
        return file.read_bytes()

    return member


def _read(path: Path, member: _Members) -> SplatFile:
    meta = _meta(path, member)
    n = meta.count
    require_at_most(path, n, MOST_GAUSSIANS, "Gaussians")

    def pixels(name: str) -> np.ndarray:
        found = _image(path, member, name).reshape(-1, 4)
        if len(found) < n:
            raise DyngsError(
                f"{path}: {name:.60} has {len(found):,} pixels for {n:,} Gaussians; export it again"
            )
        return found[:n]

    lower, upper = (pixels(name)[:, :3].astype(np.uint16) for name in meta.means.files)
    low = np.array(meta.means.mins)
    high = np.array(meta.means.maxs)
    with np.errstate(over="ignore", invalid="ignore"):  # ranges of others may be absurd
        far = low + (lower | (upper << 8)) / 65535 * (high - low)
        means = (np.sign(far) * np.expm1(np.abs(far))).astype(np.float32)
    coded = pixels(meta.quats.files[0])
    if int(coded[:, 3].min()) < _MODE:
        raise DyngsError(
            f"{path}: {meta.quats.files[0]:.60} names entries of rotations that do not exist"
        )
    quats = with_largest(
        coded[:, 3] - _MODE, (coded[:, :3].astype(np.float32) / 255 - 0.5) / _HALF_ROOT
    )
    base = pixels(meta.sh0.files[0])
    sh = np.array(meta.sh0.codebook, np.float32)[base[:, :3]][:, None]
    if meta.shN is not None:
        sh = np.concatenate([sh, _rest(path, member, meta.shN, pixels(meta.shN.files[1]))], axis=1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(
            np.array(meta.scales.codebook, np.float32)[pixels(meta.scales.files[0])[:, :3]]
        ),
        logit_opacities=torch.from_numpy(logit(base[:, 3].astype(np.float32) / 255)),
        sh=torch.from_numpy(sh),
    )
    mode = RasterizeMode.ANTIALIASED if meta.antialias else RasterizeMode.CLASSIC
    return described(
        SplatFile(gaussians, mode, comments=stored_comments(meta.asset.comments)), path
    )


def _rest(path: Path, member: _Members, rest: _Rest, labels: np.ndarray) -> np.ndarray:
    name = rest.files[0]
    terms = num_sh_terms(rest.bands) - 1
    image = _image(path, member, name)
    row = labels[:, 0].astype(np.int64) | (labels[:, 1].astype(np.int64) << 8)
    fits = image.shape[1] == _PER_ROW * terms and image.shape[0] * _PER_ROW >= rest.count
    if not fits or int(row.max()) >= rest.count:
        raise DyngsError(
            f"{path}: {name:.60} does not hold the {rest.count:,} harmonics that are named; export it again"
        )
    table = np.array(rest.codebook, np.float32)[image[..., :3]].reshape(-1, terms, 3)
    return table[row]


def _meta(path: Path, member: _Members) -> _Meta:
    text = member(SOG_META, _MOST_META_BYTES, f"bytes of {SOG_META}")
    try:
        tree = json.loads(text)
        if isinstance(tree, dict) and tree.get("version") != 2:
            raise DyngsError(
                f"{path}: is a .sog of version {tree.get('version', 1)!r:.20}, only 2 is known"
            )
        return _Meta.model_validate(tree)
    except (ValueError, RecursionError) as error:
        problem = str(error)
        if type(error) is ValidationError:
            first = error.errors(include_url=False)[0]
            problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise DyngsError(
            f"{path}: its meta.json is no .sog's ({problem:.120}); export it again"
        ) from error


def _image(path: Path, member: _Members, name: str) -> np.ndarray:
    from PIL import Image

    data = member(name, 8 * _MOST_PIXELS, "bytes of an image")
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
            require_at_most(path, image.width * image.height, _MOST_PIXELS, "pixels of an image")
            return np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DyngsError(
            f"{path}: {name:.60} cannot be read ({str(error)[:80]}); export it again"
        ) from error
