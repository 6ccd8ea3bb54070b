"""Image files: PNG, JPEG, EXR (parts and layers), TIFF, HEIC, WebP; EXIF tags and area
downscaling."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import encode_srgb
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.io.containment import check_inside, check_size, max_decoded_mb
from dyngs.io.fields import first_few
from dyngs.io.write import image_error, read_lenient_text

if TYPE_CHECKING:
    import OpenImageIO


BEAUTY_NAMES = (
    "", "rgba", "rgb", "combined", "c", "ci", "beauty", "main", "image", "final", "color", "colour",
    "composite",
)  # fmt: skip
"""Last words of layer names that denote the beauty pass, best first; "" for channels without a
layer."""
_SHORT = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}


@dataclass(frozen=True)
class ExrLayer:
    """One EXR layer: the part that contains it, and channel indices by lower-case name."""

    name: str
    part: int
    channels: dict[str, int]

    @property
    def colours(self) -> tuple[int, ...]:
        """Indices of red, green and blue, or of luminance (Y without X); empty if there are
        none."""
        names = "y" if "y" in self.channels and "x" not in self.channels else "rgb"
        found = tuple(self.channels[name] for name in names if name in self.channels)
        return found if len(found) == len(names) else ()


def list_layers(parts: Sequence[tuple[str, Sequence[str]]]) -> list[ExrLayer]:
    """Return the layers of an EXR, given its parts as (name, channel names such as
    ``layer.R``)."""
    layers: dict[tuple[int, str], ExrLayer] = {}
    for number, (part, names) in enumerate(parts):
        for index, name in enumerate(names):
            prefix, _, channel = name.rpartition(".")
            layer = prefix or (part if len(parts) > 1 else "")
            found = layers.setdefault((number, layer), ExrLayer(layer, number, {}))
            found.channels[_SHORT.get(channel.lower(), channel.lower())] = index
    return list(layers.values())


def find_beauty_pass(layers: Sequence[ExrLayer]) -> ExrLayer | None:
    """Return the beauty pass, None if no layer or several layers qualify.

    Blender's compositor writes ``Composite.Combined`` next to the ``Combined`` of each view layer.
    """
    ranked: dict[tuple[int, bool], list[ExrLayer]] = {}
    for layer in layers:
        first, _, last = layer.name.lower().rpartition(".")
        if layer.colours and last in BEAUTY_NAMES:
            ranked.setdefault((BEAUTY_NAMES.index(last), first != "composite"), []).append(layer)
    best = ranked[min(ranked)] if ranked else []
    return best[0] if len(best) == 1 else None


_FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)
_FOCAL_RANGE = (0.1, 20.0)
"""Plausible focal lengths in longer sides of the image; other values in tags are ignored."""


def is_rotated_sideways(orientation: int) -> bool:
    """Whether this EXIF orientation swaps width and height."""
    return orientation >= 5


def rotate_upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return the (H, W, D) image rotated upright by its EXIF orientation; exact."""
    down = orientation in (3, 4, 6, 7)
    across = orientation in (2, 3, 7, 8)
    rotated = pixels[:: -1 if down else 1, :: -1 if across else 1]
    return np.ascontiguousarray(
        rotated.swapaxes(0, 1) if is_rotated_sideways(orientation) else rotated
    )


def _focal_px(spec: OpenImageIO.ImageSpec) -> float | None:
    """Return the focal length from its 35 mm film equivalent, by the ratio of diagonals."""
    film = spec.get_float_attribute(
        "Exif:FocalLengthIn35mmFilm", spec.get_int_attribute("Exif:FocalLengthIn35mmFilm")
    )
    focal = film / _FULL_FRAME_DIAGONAL_MM * math.hypot(spec.width, spec.height)
    low, high = _FOCAL_RANGE
    return focal if low <= focal / max(spec.width, spec.height, 1) <= high else None


def _exposure(spec: OpenImageIO.ImageSpec) -> float | None:
    seconds = spec.get_float_attribute("ExposureTime")
    sensitivity = spec.get_int_attribute("Exif:PhotographicSensitivity") or 100
    stop = spec.get_float_attribute("FNumber") or 1.0
    light = seconds * sensitivity / 100 / stop**2
    return light if math.isfinite(light) and light > 0 else None


SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff", ".webp", ".bmp")
_TAIL_BYTES = 4096
_STRIP_PIXELS = 2**18  # pixels of an image that are shrunk at a time
END_MARKERS = {"png": b"IEND", "jpeg": b"\xff\xd9"}
"""Last bytes of complete files, by ``ImageHeader.format_name``."""


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file.

    Attributes:
        width, height: stored size; of an EXR the display window.
        channels: number of stored channels.
        colours, alpha: indices of the colour channels that are read, and of alpha.
        is_float: values are linear floats.
        is_premultiplied: colours are multiplied by alpha.
        format_name: OpenImageIO's name of the format, from the content.
        layer: name of the beauty pass chosen among several EXR layers, else "".
        orientation: EXIF orientation: 1 = upright, 2 to 4 = mirrored or upside down, 5 to 8 =
            sideways.
        focal_px: focal length in pixels of the stored image, None without EXIF.
        exposure: seconds x ISO / 100 / f-number squared, each factor 1 if its tag is missing; None
            without an exposure time.
        camera: name of the camera model.
    """

    width: int
    height: int
    channels: int
    colours: tuple[int, ...]
    alpha: int | None
    is_float: bool
    is_premultiplied: bool
    format_name: str
    layer: str
    orientation: int
    focal_px: float | None
    exposure: float | None
    camera: str

    @property
    def size(self) -> tuple[int, int]:
        """Stored (width, height)."""
        return self.width, self.height

    @property
    def upright_size(self) -> tuple[int, int]:
        """(width, height) after rotation by the EXIF orientation."""
        return (self.height, self.width) if is_rotated_sideways(self.orientation) else self.size

    def size_matching(self, described: tuple[int, int] | None) -> tuple[int, int]:
        """Return the stored or the upright (width, height), whichever has the orientation of
        ``described``.

        Pose estimators use images as stored or upright, which the size of their cameras shows. If
        both match, the stored size is returned, as in COLMAP.
        """
        if described is None:
            return self.upright_size
        wide, tall = described
        lies = (wide > tall) != (self.width > self.height) and wide != tall
        return self.upright_size if lies else self.size


def list_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Return the files directly in a folder with one of the suffixes, by name, without hidden
    files."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted(
        path
        for path in found
        if path.suffix.lower() in suffixes and path.is_file() and not path.name.startswith(".")
    )


def read_header(path: Path) -> ImageHeader:
    """Read the size, channels and EXIF tags of an image without decoding it."""
    with _reading(path):
        reader, header = _open(path)
        reader.close()
        return header


def try_read_header(path: Path) -> ImageHeader | None:
    """Read the header of an image; None if it is missing or damaged, which the loader reports.

    Raises DyngsError if the image lies outside the capture, or is too large.
    """
    check_inside(path)
    try:
        header = read_header(path)
    except DyngsError:
        return None
    check_size(path, header.width, header.height, header.channels)
    return header


def read_image(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> Tensor:
    """Read an image as (H, W, 3) or, with alpha, (H, W, 4) uint8: sRGB, straight alpha.

    8-bit files are returned bit for bit, 16-bit values are rounded. Float files (EXR) are linear:
    they are clamped to [0, 1] and encoded as sRGB. Premultiplied colours (EXR, TIFF with
    associated alpha) are divided by alpha. Grey becomes RGB. Of an EXR with several layers, the
    beauty pass is read, in its display window.

    Args:
        size: (width, height) of its camera; the image is rotated by its EXIF tag if only then its
            orientation matches. None: as stored.
        upright: always rotate by the EXIF tag.
    """
    import OpenImageIO as oiio

    with _reading(path):
        reader, header = _open(path)
        is_exact = not header.is_float and not header.is_premultiplied
        kind = oiio.TypeDesc(oiio.UINT8 if is_exact else oiio.FLOAT)
        pixels = _decoded(path, reader, kind)
        if upright or (size is not None and header.size_matching(size) != header.size):
            pixels = rotate_upright(pixels, header.orientation)
        return torch.as_tensor(np.ascontiguousarray(_straight_srgb(pixels, header)), device="cpu")


def _reading(path: Path) -> AbstractContextManager[None]:
    return wrap_read_errors(
        path, "the image is damaged or its format is not supported; copy or convert it again"
    )


def read_raw(path: Path) -> tuple[np.ndarray, bool]:
    """Read stored values as (H, W, D) float32, and whether they are integers."""
    with _reading(path):
        reader = _open_reader(path)
        spec = reader.spec()
        return _decoded(path, reader, spec.format).astype(np.float32), not _is_float(spec)


def read_mask(path: Path) -> Tensor:
    """Read a mask as (H, W) bool: true = used, where the mean of the colour channels is at least
    half."""
    return read_image(path)[..., :3].float().mean(dim=-1) >= 127.5


def check_image(path: Path) -> ImageHeader:
    """Read the header and check that the file is complete; a JPEG without end marker is
    decoded."""
    header = read_header(path)
    check_size(path, header.width, header.height, header.channels)
    marker = END_MARKERS.get(header.format_name, b"")
    with _reading(path), path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        is_complete = marker in file.read()
    if not is_complete and header.format_name == "jpeg":
        read_image(path)
    elif not is_complete:  # not decoded, as libpng would print messages
        raise DyngsError(f"{path}: the image is truncated; copy it again")
    return header


def target_size(
    width: int, height: int, downscale: float = 1.0, longest_side: int | None = None
) -> tuple[int, int]:
    """Return (width, height) divided by ``downscale`` and limited to ``longest_side``; never
    enlarged."""
    factor = max(1.0, downscale)
    if longest_side is not None:
        factor = max(factor, max(width, height) / longest_side)
    return max(1, math.floor(width / factor + 0.5)), max(1, math.floor(height / factor + 0.5))


def area_downscale(pixels: Tensor, width: int, height: int) -> Tensor:
    """Downscale ``pixels`` (H, W, D) to (height, width, D) by exact area averages.

    Floating point with premultiplied colours. For non-integer factors border pixels are weighted
    by their covered fraction.
    """
    return _shrink_axis(_shrink_axis(pixels, 0, pixels.shape[0], height), 1, pixels.shape[1], width)


def area_downscale_uint8(pixels: Tensor, width: int, height: int) -> Tensor:
    """Downscale uint8 pixels with straight alpha by area averages, in strips of rows.

    Equal to ``to_straight_uint8(area_downscale(premultiply(pixels), width, height))``, but needs
    much less memory for large photos.
    """
    old = pixels.shape[0]
    step = max(1, _STRIP_PIXELS * height // (old * pixels.shape[1]))
    parts = []
    for begin in range(0, height, step):
        end = min(begin + step, height)
        first = begin * old // height
        last = min(-(-end * old // height), old)
        rows = premultiply(pixels[first:last])
        part = _shrink_axis(rows, 0, old, height, (begin, end), first)
        parts.append(to_straight_uint8(_shrink_axis(part, 1, part.shape[1], width)))
    return torch.cat(parts)


def premultiply(pixels: Tensor) -> Tensor:
    """Return (H, W, 3 or 4) float32 in [0, 1], colours multiplied by alpha, from straight
    uint8."""
    scaled = pixels.float() / 255
    if scaled.shape[-1] == 4:
        scaled[..., :3] *= scaled[..., 3:]
    return scaled


def to_straight_uint8(pixels: Tensor) -> Tensor:
    """Return (H, W, 3 or 4) uint8 with straight alpha from premultiplied floats; inverts
    ``premultiply``."""
    if pixels.shape[-1] == 4:
        alpha = pixels[..., 3:].clamp(0, 1)
        rgb = torch.where(alpha > 0, pixels[..., :3] / alpha.clamp(min=1e-6), 0)
        pixels = torch.cat([rgb, alpha], dim=-1)
    return (pixels.clamp(0, 1) * 255).round().to(torch.uint8)


def _open(path: Path) -> tuple[OpenImageIO.ImageInput, ImageHeader]:
    """Open an image at the part to be read, of an EXR with several layers the beauty pass."""
    reader = _open_reader(path)
    name = reader.format_name()
    layer = _exr_layer(path, reader) if name == "openexr" else None
    spec = reader.spec()
    # OpenImageIO counts alpha from 1 for GIF.
    alpha = min(spec.alpha_channel, spec.nchannels - 1) if spec.alpha_channel >= 0 else None
    colours = tuple(index for index in range(spec.nchannels) if index != alpha)
    if layer is not None and layer.colours:
        alpha = layer.channels.get("a")
        colours = layer.colours
    if not colours:
        raise DyngsError(f"{path}: the image has no colour channel; use an RGB or RGBA image")
    is_straight = spec.get_int_attribute("oiio:UnassociatedAlpha") == 1
    orientation = spec.get_int_attribute("Orientation", 1)
    return reader, ImageHeader(
        *_shown_size(reader),
        channels=spec.nchannels,
        colours=colours[:3] if len(colours) >= 3 else colours[:1] * 3,
        alpha=alpha,
        is_float=_is_float(spec),
        is_premultiplied=alpha is not None and not is_straight and name in ("openexr", "tiff"),
        format_name=name,
        layer="" if layer is None else layer.name,
        orientation=orientation if 1 <= orientation <= 8 else 1,
        focal_px=_focal_px(spec),
        exposure=_exposure(spec),
        camera=read_lenient_text(partial(spec.get_string_attribute, "Model")),
    )


def _open_reader(path: Path) -> OpenImageIO.ImageInput:
    import OpenImageIO as oiio

    if not path.is_file():
        raise DyngsError(f"{path}: no such image; restore it or remove it from the capture")
    # Some readers of OpenImageIO allocate the image when they open the file.
    oiio.attribute("limits:imagesize_MB", max_decoded_mb())
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    reader = oiio.ImageInput.open(str(path), config)
    if reader is None:
        reason = image_error(oiio) or "unknown format"
        raise DyngsError(f"{path}: cannot be read as an image ({reason}); copy or convert it again")
    return reader


def _exr_layer(path: Path, reader: OpenImageIO.ImageInput) -> ExrLayer | None:
    """Seek the part of the beauty pass and return that layer; None if the file has a single
    layer."""
    parts: list[tuple[str, Sequence[str]]] = []
    while reader.seek_subimage(len(parts), 0):
        spec = reader.spec()
        # Deep parts hold samples at several depths instead of pixels.
        names = () if spec.deep else spec.channelnames
        parts.append(
            (read_lenient_text(partial(spec.get_string_attribute, "oiio:subimagename")), names)
        )
    layers = list_layers(parts)
    if not layers:
        raise DyngsError(f"{path}: deep EXR images are not supported; flatten it")
    chosen = layers[0] if len(layers) == 1 else find_beauty_pass(layers)
    if chosen is None:
        raise DyngsError(
            f"{path}: cannot tell which layer is the image; name one rgba, Combined, C or "
            "beauty, or save it alone. The file has "
            f"{first_few([layer.name or 'an unnamed layer' for layer in layers])}"
        )
    reader.seek_subimage(chosen.part, 0)
    return chosen if len(layers) > 1 else None


def _decoded(path: Path, reader: OpenImageIO.ImageInput, kind: OpenImageIO.TypeDesc) -> np.ndarray:
    """Return the pixels (H, W, D) of a part; for EXR the display window, 0 outside the data
    window."""
    import OpenImageIO as oiio

    spec = reader.spec()
    width, height = _shown_size(reader)
    check_size(path, spec.width, spec.height * max(spec.depth, 1), spec.nchannels)
    check_size(path, width, height, spec.nchannels)
    pixels = reader.read_image(kind)
    message = image_error(reader)
    reader.close()
    # A truncated JPEG decodes to an image with a grey lower part and a message.
    if pixels is None or "premature" in message.lower():
        reason = message or "the data ends early"
        raise DyngsError(f"{path}: the image is truncated or damaged ({reason}); copy it again")
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    left = spec.full_x - spec.x
    top = spec.full_y - spec.y
    if reader.format_name() == "openexr":
        window = oiio.ROI(left, left + width, top, top + height, 0, 1, 0, spec.nchannels)
        if (left, top, width, height) != (0, 0, spec.width, spec.height):
            shown = oiio.ImageBufAlgo.crop(oiio.ImageBuf(pixels), window)
            pixels = np.asarray(shown.get_pixels(kind))
    return pixels


def _shown_size(reader: OpenImageIO.ImageInput) -> tuple[int, int]:
    """Return (width, height) of the display window of an EXR, or the stored size of other
    images."""
    spec = reader.spec()
    if reader.format_name() == "openexr":
        return spec.full_width, spec.full_height
    return spec.width, spec.height


def _is_float(spec: OpenImageIO.ImageSpec) -> bool:
    import OpenImageIO as oiio

    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


def _straight_srgb(pixels: np.ndarray, header: ImageHeader) -> np.ndarray:
    """Return (H, W, 3 or 4) uint8 sRGB with straight alpha; linear floats are encoded."""
    channels = [*header.colours, *([] if header.alpha is None else [header.alpha])]
    if channels != list(range(pixels.shape[-1])):  # most files need no copy
        pixels = pixels[..., channels]
    if pixels.dtype == np.uint8:
        return pixels
    pixels = np.nan_to_num(pixels, nan=0.0, posinf=1.0, neginf=0.0)
    if header.is_premultiplied:
        alpha = np.clip(pixels[..., 3:], 0, 1)
        pixels[..., :3] = np.where(alpha > 0, pixels[..., :3] / np.maximum(alpha, 1e-6), 0)
    pixels = np.clip(pixels, 0, 1)
    if header.is_float:
        pixels[..., :3] = encode_srgb(pixels[..., :3])
    return np.round(pixels * 255).astype(np.uint8)


def _shrink_axis(
    pixels: Tensor,
    axis: int,
    old: int,
    size: int,
    outputs: tuple[int, int] | None = None,
    first_input: int = 0,
) -> Tensor:
    """Shrink an axis from ``old`` to ``size``; compute only ``outputs`` (begin, end), None for
    all.

    ``pixels`` starts at index ``first_input`` of the axis.
    """
    begin_at, end_at = outputs or (0, size)
    if size == old:
        return pixels
    if size > old:
        raise ValueError(f"area_downscale cannot enlarge {old} to {size}")
    if old % size == 0:  # integer factor: equal weights, no gathers, the same sums
        taps = pixels.narrow(
            axis, begin_at * old // size - first_input, (end_at - begin_at) * old // size
        )
        taps = taps.unflatten(axis, (-1, old // size)).unbind(axis + 1)
        return sum((tap * (size / old) for tap in taps), pixels.new_zeros(1))
    # Output i covers [i * old / size, (i + 1) * old / size): integer arithmetic keeps the fractions
    # exact.
    starts = torch.arange(begin_at, end_at + 1, device=pixels.device) * old
    first = starts[:-1] // size
    shape = [1] * pixels.ndim
    shape[axis] = end_at - begin_at
    total = pixels.new_zeros(1)
    for tap in range(-(-old // size) + 1):
        index = first + tap
        begin = torch.maximum(index * size, starts[:-1])
        end = torch.minimum((index + 1) * size, starts[1:])
        fraction = ((end - begin).clamp(min=0).double() / old).to(pixels.dtype).reshape(shape)
        position = (index - first_input).clamp(max=pixels.shape[axis] - 1)
        total = total + pixels.index_select(axis, position) * fraction
    return total
