"""Writers of short clips in HDR and wide gamuts; they encode what dyngs decodes."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import numpy as np

PQ, HLG = 16, 18
BT709, BT601, BT2020, DISPLAY_P3 = 1, 5, 9, 12
UNSPECIFIED = 2

_CHROMATICITIES = {
    BT709: [(0.64, 0.33), (0.3, 0.6), (0.15, 0.06)],
    BT2020: [(0.708, 0.292), (0.17, 0.797), (0.131, 0.046)],
    DISPLAY_P3: [(0.68, 0.32), (0.265, 0.69), (0.15, 0.06)],
}
_LUMA = {BT709: (0.2126, 0.0722), BT601: (0.299, 0.114), BT2020: (0.2627, 0.0593)}
"""Weights of red and blue in the luma of a matrix."""


def patches() -> np.ndarray:
    """(48, 64, 3) sRGB in [0, 1]: squares of 16 px of random colours, one white, one black."""
    colours = np.random.default_rng(5).uniform(0.05, 0.95, (3, 4, 3))
    colours[0, 0], colours[2, 3] = 1.0, 0.0
    return np.kron(colours, np.ones((16, 16, 1)))


def encoded(rgb: np.ndarray, primaries: int, transfer: int) -> np.ndarray:
    """The signal of an sRGB image in other primaries and another curve; SDR has that of sRGB."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = (linear @ (np.linalg.inv(_to_xyz(primaries)) @ _to_xyz(BT709)).T).clip(0, 1)
    if transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = linear * 0.26496256  # the light whose signal is 75 %
        return np.where(
            scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c
        )
    if transfer == PQ:
        power = (linear * 203 / 10_000) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def write_clip(
    path: Path,
    signal: np.ndarray,
    tags: tuple[int, int, int],
    *,
    matrix: int = BT2020,
    bits: int = 10,
    is_full_range: bool = False,
    codec: str = "libx264",
    count: int = 2,
) -> None:
    """A clip of an RGB ``signal`` (H, W, 3), stored by ``matrix``, tagged (primaries, transfer,
    matrix)."""
    red, blue = _LUMA[matrix]
    luma = signal @ [red, 1 - red - blue, blue]
    planes = [
        luma,
        (signal[..., 2] - luma) / (2 - 2 * blue),
        (signal[..., 0] - luma) / (2 - 2 * red),
    ]
    step = 2 ** (bits - 8)
    most = 2**bits - 1
    scales = (
        [(most, 0), (most, 128 * step)]
        if is_full_range
        else [(219 * step, 16 * step), (224 * step, 128 * step)]
    )
    numbers = []
    for index, plane in enumerate(planes):
        scale, offset = scales[min(index, 1)]
        small = plane if index == 0 else plane.reshape(len(plane) // 2, 2, -1, 2).mean((1, 3))
        numbers.append((small * scale + offset).round().clip(0, most))
    pixel_format = "yuv420p10le" if bits == 10 else "yuv420p"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = signal.shape[:2]
        stream.pix_fmt = pixel_format
        stream.options = {"crf": "4", "threads": "1", "x265-params": "log-level=none"}
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = tags
        context.color_range = 2 if is_full_range else 1
        for number in range(count):
            frame = av.VideoFrame(stream.width, stream.height, pixel_format)
            frame.pts = number
            frame.color_range = context.color_range
            frame.colorspace = tags[2]
            for plane, values in zip(frame.planes, numbers, strict=True):
                kind = np.uint16 if bits == 10 else np.uint8
                stored = np.zeros((plane.height, plane.line_size // np.dtype(kind).itemsize), kind)
                stored[:, : plane.width] = values
                plane.update(stored.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def add_colour_box(
    path: Path, primaries: int, transfer: int, matrix: int, is_full_range: bool = False
) -> None:
    """Give the first track of an MP4, whose index comes last, the box ``colr`` of a container's
    tags."""
    data = bytearray(path.read_bytes())
    begin = 0
    end = len(data)
    opened = []
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", None):
        size, kind = struct.unpack_from(">I4s", data, begin)
        while name is not None and kind != name:
            begin += size
            size, kind = struct.unpack_from(">I4s", data, begin)
        opened.append(begin)
        end = begin + size
        begin += 16 if name == b"stsd" else 8
    old = data.find(b"colr", begin, end)
    box = struct.pack(
        ">I4s4s3HB", 19, b"colr", b"nclx", primaries, transfer, matrix, is_full_range << 7
    )
    removed = 0 if old < 0 else struct.unpack_from(">I", data, old - 4)[0]
    if removed:
        del data[old - 4 : old - 4 + removed]
    data[end - removed : end - removed] = box
    for place in opened:
        struct.pack_into(
            ">I", data, place, struct.unpack_from(">I", data, place)[0] + len(box) - removed
        )
    path.write_bytes(data)


def _to_xyz(primaries: int) -> np.ndarray:
    corners = np.array([(x / y, 1, (1 - x - y) / y) for x, y in _CHROMATICITIES[primaries]]).T
    white = np.array([0.3127 / 0.329, 1, (1 - 0.3127 - 0.329) / 0.329])
    return corners * np.linalg.solve(corners, white)
