"""Sheets of images with captions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_GREY = (32, 32, 32)
_TEXT = (217, 217, 217)


def labelled_sheet(
    bands: Sequence[Sequence[tuple[str, np.ndarray]]], side: int = 480
) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 with one row of captioned images per band.

    Images wider than ``side`` px are downscaled. Captions are cut to the width of the image.

    Args:
        bands: caption and image (H, W, 3) uint8 of each cell.
        side: largest width of a cell, px.
    """
    from PIL import Image, ImageDraw

    rows = []
    for band in bands:
        row = []
        for text, pixels in band:
            panel = Image.fromarray(pixels)
            panel.thumbnail((side, panel.height), Image.Resampling.BOX)
            cell = Image.new("RGB", (panel.width + 6, panel.height + 22), _GREY)
            cell.paste(panel, (0, 22))
            ImageDraw.Draw(cell).text((2, 5), text, fill=_TEXT)
            row.append(cell)
        rows.append(row)
    width = max(sum(cell.width for cell in row) for row in rows)
    height = sum(max(cell.height for cell in row) for row in rows)
    sheet = Image.new("RGB", (6 + width, height + 6), _GREY)
    top = 0
    for row in rows:
        left = 6
        for cell in row:
            sheet.paste(cell, (left, top))
            left += cell.width
        top += max(cell.height for cell in row)
    return np.asarray(sheet)
