"""PlayCanvas' ``.sog``: a zip of lossless WebP images with a pixel per Gaussian, and ``meta.json``;
version 2.

Positions take 16 bits per axis on a logarithmic scale, rotations 26 bits, scales and colours index
a table of 256 values, and harmonics above degree 0 a palette of up to 65,536 rows of such indices.
Axes are those of the .ply.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dyngs.core.conventions import RasterizeMode
from dyngs.core.gaussians import Gaussians, morton_order
from dyngs.io.fields import require_at_most
from dyngs.io.formats.packing import (
    codebook,
    logit,
    nearest_entries,
    palette,
    restore_largest,
    split_largest,
)
from dyngs.io.formats.splat_file import (
    MAX_GAUSSIANS,
    SplatFile,
    comments_from_json,
    header_comments,
    parse_comments,
)

_META = "meta.json"
_PER_ROW = 64
_MOST_META_BYTES = 1 << 20
_MOST_PIXELS = 1 << 27
_MODE = 252  # alpha of a rotation: this plus the index of its largest entry
_HALF_ROOT = float(np.sqrt(0.5))


def read_sog(path: Path) -> SplatFile:
    """Read a .sog of version 2. Raises ValueError: damaged; DyngsError: too much memory needed."""
    with zipfile.ZipFile(path) as archive:
        return _read(path, archive)


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
    largest, others = split_largest(gaussians.quats.numpy())
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
        terms = rows.shape[1] // 3
        # 64 rows side by side, a pixel per term
        centroids = np.zeros((_PER_ROW * -(-len(rows) // _PER_ROW), terms, 4), np.uint8)
        centroids[..., 3] = 255
        centroids[: len(rows), :, :3] = nearest_entries(values, rows).reshape(-1, terms, 3)
        images["shN_centroids.webp"] = centroids.reshape(-1, _PER_ROW * terms, 4)
        files = ["shN_centroids.webp", labelled]
        meta["shN"] = {
            "count": len(rows),
            "bands": gaussians.sh_degree,
            "codebook": values.tolist(),
            "files": files,
        }
    yield _META, json.dumps(meta).encode()
    for name, image in images.items():
        yield name, _encoded(image)


def _encoded(image: np.ndarray) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image, "RGBA").save(
        out, "WEBP", lossless=True, exact=True, quality=75, method=4
    )
    return out.getvalue()


def _member(path: Path, archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    info = archive.getinfo(name)
    require_at_most(path, info.file_size, most, "bytes")
    return archive.read(info)


def _read(path: Path, archive: zipfile.ZipFile) -> SplatFile:
    meta = json.loads(_member(path, archive, _META, _MOST_META_BYTES))
    if meta.get("version", 1) != 2:
        raise ValueError(
            f"it is a .sog of version {meta.get('version', 1)!r:.20}, only version 2 is supported"
        )
    n = meta["count"]
    if type(n) is not int or n < 1:
        raise ValueError("its 'count' is not a positive integer")
    require_at_most(path, n, MAX_GAUSSIANS, "Gaussians")

    def pixels(part: str, index: int = 0) -> np.ndarray:
        found = _image(path, archive, meta[part]["files"][index]).reshape(-1, 4)
        if len(found) < n:
            raise ValueError(f"its {part} has {len(found):,} pixels for {n:,} Gaussians")
        return found[:n]

    def table(part: str) -> np.ndarray:
        found = np.array(meta[part]["codebook"], np.float32)
        if found.shape != (256,) or not np.isfinite(found).all():
            raise ValueError(f"the codebook of {part!r} must have 256 values")
        return found

    lower, upper = (pixels("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):  # ranges of others may be absurd
        far = low + (lower | (upper << 8)) / 65535 * (high - low)
        means = (np.sign(far) * np.expm1(np.abs(far))).astype(np.float32)
    coded = pixels("quats")
    if int(coded[:, 3].min()) < _MODE:
        raise ValueError("it contains invalid rotations")
    others = (coded[:, :3].astype(np.float32) / 255 - 0.5) / _HALF_ROOT
    base = pixels("sh0")
    sh = table("sh0")[base[:, :3]][:, None]
    if meta.get("shN") is not None:
        bands = meta["shN"]["bands"]
        terms = {1: 3, 2: 8, 3: 15}[bands]
        image = _image(path, archive, meta["shN"]["files"][0])
        labels = pixels("shN", 1).astype(np.int64)
        if image.shape[1] != _PER_ROW * terms:
            raise ValueError(f"its SH image must have {_PER_ROW} x {terms} columns")
        rows = table("shN")[image[..., :3]].reshape(-1, terms, 3)
        sh = np.concatenate([sh, rows[labels[:, 0] | labels[:, 1] << 8]], axis=1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(restore_largest(coded[:, 3] - _MODE, others)),
        log_scales=torch.from_numpy(table("scales")[pixels("scales")[:, :3]]),
        logit_opacities=torch.from_numpy(logit(base[:, 3].astype(np.float32) / 255)),
        sh=torch.from_numpy(sh),
    )
    mode = RasterizeMode.ANTIALIASED if meta.get("antialias") else RasterizeMode.CLASSIC
    asset = meta.get("asset")
    comments = comments_from_json(asset.get("comments") if isinstance(asset, dict) else None)
    return parse_comments(SplatFile(gaussians, mode, comments=comments))


def _image(path: Path, archive: zipfile.ZipFile, name: str) -> np.ndarray:
    from PIL import Image

    data = _member(path, archive, name, 8 * _MOST_PIXELS)
    with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
        require_at_most(path, image.width * image.height, _MOST_PIXELS, "pixels of an image")
        return np.asarray(image.convert("RGBA"))
