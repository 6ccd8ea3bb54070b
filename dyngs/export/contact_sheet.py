"""Contact sheets of ground truth, render and error, and coloured depth maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.data.images.colour_space import srgb_encoded
from dyngs.io.write import to_uint8

GAP = 6
LABEL_HEIGHT = 22
LARGEST_TEXT, SMALLEST_TEXT = 14, 9
BACKGROUND = 32


@dataclass(frozen=True)
class SheetRow:
    """One view of a contact sheet."""

    label: str  # text above it, such as name and PSNR
    # ``truth, rendered``: (H, W, 3), uint8 or float in [0, 1], of the same size
    truth: np.ndarray
    rendered: np.ndarray


def contact_sheet(
    rows: Sequence[SheetRow], error_gain: float = 5.0, panel_width: int = 480
) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 with truth, render and error side by side, one labelled view
    per row.

    The error is the mean absolute difference of the channels times ``error_gain``, in magma colours
    (black = equal). Images wider than ``panel_width`` are shrunk, after the difference was taken.
    Raises ValueError: no rows, or a truth and a render of different sizes.
    """
    if not rows:
        raise ValueError("a contact sheet needs at least one row")
    bands = []
    for row in rows:
        if row.truth.shape != row.rendered.shape or row.truth.ndim != 3:
            raise ValueError(
                f"{row.label}: truth {row.truth.shape} and render {row.rendered.shape} differ in shape"
            )
        truth = to_uint8(row.truth)
        rendered = to_uint8(row.rendered)
        difference = (
            np.abs(truth.astype(np.float32) - rendered.astype(np.float32)).mean(axis=2) / 255.0
        )
        panels = (truth, rendered, color_map(error_gain * difference, "magma"))
        bands.append(
            _band(
                row.label,
                f"error x{error_gain:g}",
                [_shrink(panel, panel_width) for panel in panels],
            )
        )
    width = max(band.shape[1] for band in bands)
    padded = [
        np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=BACKGROUND)
        for b in bands
    ]
    return np.pad(np.concatenate(padded), ((0, GAP), (0, 0), (0, 0)), constant_values=BACKGROUND)


def depth_limits(depth: np.ndarray, alpha: np.ndarray) -> tuple[float, float]:
    """Return near and far for ``depth_to_rgb``: the 1st and 99th percentile of depth where alpha is
    at least 0.5.

    Any equal shapes, so that the frames of a video can share limits. (0, 1) if nothing is opaque.
    """
    seen = depth[(alpha >= 0.5) & np.isfinite(depth)]
    if not seen.size:
        return 0.0, 1.0
    near, far = np.percentile(seen, [1.0, 99.0])
    return float(near), float(far)


def depth_to_rgb(
    depth: np.ndarray, alpha: np.ndarray, limits: tuple[float, float] | None = None
) -> np.ndarray:
    """Return depth as colours (H, W, 3) uint8: near is red, far is blue (turbo), darkened to black
    where alpha is 0.

    ``depth``: (H, W) expected depth in world units; non-finite values count as far. ``alpha``: (H,
    W) in [0, 1]. ``limits``: near and far; None: ``depth_limits`` of this image.
    """
    near, far = limits or depth_limits(depth, alpha)
    fraction = (far - np.nan_to_num(depth, nan=far, posinf=far, neginf=near)) / max(
        far - near, 1e-12
    )
    colors = color_map(np.clip(fraction, 0.0, 1.0), "turbo").astype(np.float32)
    return (colors * np.clip(alpha, 0.0, 1.0)[..., None] + 0.5).astype(np.uint8)


def color_map(values: np.ndarray, name: str) -> np.ndarray:
    """Return colours (H, W, 3) uint8 of values (H, W) in [0, 1], by a colour map of OpenImageIO
    (magma, turbo...)."""
    import OpenImageIO as oiio

    source = oiio.ImageBuf(
        np.ascontiguousarray(np.clip(values, 0.0, 1.0)[..., None], dtype=np.float32)
    )
    colored = oiio.ImageBufAlgo.color_map(source, 0, name)
    if colored.has_error:
        raise ValueError(f"no colour map '{name}': {colored.geterror()}")
    linear = np.clip(
        np.asarray(colored.get_pixels(oiio.FLOAT))[..., :3], 0.0, 1.0
    )  # OpenImageIO's tables are in linear light
    return to_uint8(srgb_encoded(linear))


def _band(label: str, error_name: str, panels: list[np.ndarray]) -> np.ndarray:
    height, width = panels[0].shape[:2]
    band = np.full(
        (LABEL_HEIGHT + height, GAP + len(panels) * (width + GAP), 3), BACKGROUND, np.uint8
    )
    for i, panel in enumerate(panels):
        left = GAP + i * (width + GAP)
        band[LABEL_HEIGHT:, left : left + width] = panel
    texts = (f"truth  {label}", "render", error_name)
    for i, text in enumerate(texts):
        left = GAP + i * (width + GAP)
        _write_text(band[:LABEL_HEIGHT, left : left + width], text)
    return band


def _write_text(strip: np.ndarray, text: str) -> None:
    """Write text into ``strip`` (H, W, 3) in place, nothing if no font is installed.

    It is made smaller to fit, down to a limit at which it is cut off at the strip's edge.
    """
    import OpenImageIO as oiio

    image = oiio.ImageBuf(np.ascontiguousarray(strip))
    ink = (0.85, 0.85, 0.85)
    size = LARGEST_TEXT
    while (
        size > SMALLEST_TEXT and oiio.ImageBufAlgo.text_size(text, size).width > strip.shape[1] - 4
    ):
        size -= 1
    if oiio.ImageBufAlgo.render_text(image, 2, LABEL_HEIGHT - 7, text, size, textcolor=ink):
        strip[:] = image.get_pixels(oiio.UINT8)


def _shrink(rgb: np.ndarray, width: int) -> np.ndarray:
    """Return the image (H, W, 3) uint8, area-filtered to at most ``width`` columns."""
    if rgb.shape[1] <= width:
        return rgb
    from skimage.transform import resize_local_mean

    height = max(round(rgb.shape[0] * width / rgb.shape[1]), 1)
    return to_uint8(resize_local_mean(rgb.astype(np.float32) / 255.0, (height, width)))
