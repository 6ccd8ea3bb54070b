"""Pictures of detected people: one per person, and outlines and key points of the chosen one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from dyngs.data.capture import View
from dyngs.data.images.images import read_image
from dyngs.data.times import evenly_spaced
from dyngs.human.detect.tracking import PersonTrack, expand_box
from dyngs.human.fit.keypoints import MIN_CONFIDENCE
from dyngs.io.labelled_sheet import labelled_sheet

CELL_PX = 320  # width and height of a picture
NUM_PICTURES = 12  # of the chosen person
_BONES = (
    (5, 6),
    (5, 7),
    (7, 9),
    (6, 8),
    (8, 10),
    (5, 11),
    (6, 12),
    (11, 12),
    (11, 13),
    (13, 15),
    (12, 14),
    (14, 16),
    (15, 17),
    (16, 18),
    (9, 21),
    (10, 22),
)
"""Pairs of rows in ``KEY_POINTS``; of each limb the left one comes first."""
_OUTLINE = 255, 60, 60
_LEFT = 60, 160, 255
_RIGHT = 255, 190, 40


def people_sheet(views: Sequence[View], tracks: Sequence[PersonTrack]) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 with the clearest image and the number of each person."""
    cells = []
    for number, track in enumerate(tracks, 1):
        best = max(track.numbers, key=lambda i: float(track.detections[i].keypoints[:, 2].sum()))
        pixels = _read(views[best])
        left, top, right, bottom = expand_box(
            track.detections[best].box, (1, *pixels.shape)
        ).astype(int)
        cells.append((f"person {number}, image {best}", _fit(pixels[top:bottom, left:right])))
    return labelled_sheet([cells], CELL_PX)


def detection_sheet(
    views: Sequence[View], masks: Sequence[np.ndarray], keypoints: Sequence[np.ndarray | None]
) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 of evenly spaced views with outlines and skeletons.

    Left limbs are blue, right limbs orange. Only views with key points are shown.

    Args:
        views: of all cameras.
        masks: (H, W, 1) uint8 of each view.
        keypoints: (25, 3) of each view, px; None: nobody.
    """
    from PIL import Image, ImageDraw

    shown = [row for row, points in enumerate(keypoints) if points is not None]
    cells = []
    for row in (shown[i] for i in evenly_spaced(len(shown), NUM_PICTURES)):
        points = keypoints[row]
        mask = masks[row][..., 0] > 127
        if points is None or not mask.any():
            continue
        rows, columns = ndimage.find_objects(mask.astype(np.int32))[0]
        box = np.array([columns.start, rows.start, columns.stop, rows.stop], np.float64)
        left, top, right, bottom = expand_box(box, (1, *mask.shape)).astype(int)
        pixels = _fit(_read(views[row])[top:bottom, left:right])
        scale = pixels.shape[1] / (right - left)
        inside = np.asarray(
            Image.fromarray(mask[top:bottom, left:right]).resize((pixels.shape[1], pixels.shape[0]))
        )
        pixels[ndimage.binary_dilation(inside) & ~inside] = _OUTLINE
        image = Image.fromarray(pixels)
        draw = ImageDraw.Draw(image)
        places = (points[:, :2] - [left, top]) * scale
        for start, end in _BONES:
            if min(points[start, 2], points[end, 2]) > MIN_CONFIDENCE:
                line = [tuple(places[start]), tuple(places[end])]
                draw.line(line, fill=_LEFT if end % 2 else _RIGHT, width=2)
        cells.append((views[row].name, np.asarray(image)))
    columns_per_band = -(-len(cells) // 2)
    bands = [cells[:columns_per_band], cells[columns_per_band:]]
    return labelled_sheet([band for band in bands if band], CELL_PX)


def _read(view: View) -> np.ndarray:
    return read_image(view.image_path, (view.width, view.height))[..., :3].numpy()


def _fit(pixels: np.ndarray) -> np.ndarray:
    """Return an image resized to fit a cell, as a copy."""
    from PIL import Image

    factor = CELL_PX / max(pixels.shape[:2])
    size = (max(round(pixels.shape[1] * factor), 1), max(round(pixels.shape[0] * factor), 1))
    return np.array(Image.fromarray(np.ascontiguousarray(pixels)).resize(size))
