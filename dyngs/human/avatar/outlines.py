"""Colours near outlines, before what stands behind the person: edges of found masks are wrong by a
pixel or two.

A mask cuts background into the person, or the person away, and an avatar learns these colours.
Where the camera stands, other frames show what is behind: the render is put before that, and
compared with the image as it was taken.

Local letters: F images of one camera, H height, W width.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.capture.masks import SEEN_BARE
from dyngs.data.capture import View
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.models.kind import RunStart
from dyngs.models.model import Look, Loss
from dyngs.models.views import background_colour
from dyngs.ops.device import sent
from dyngs.ops.loss import l1_ssim_loss

REACH = 2  # distance from the mask up to which images are compared as they were taken, px
OUTSIDE = 0.02  # alpha up to which a pixel is outside of the mask
FRAMES = 21  # of a camera, whose median is what is behind
# median difference, over pixels outside of the masks, from which the camera or the light has moved
STANDS = 12 / 255
# least fraction of the pixels near outlines, behind which something is known, to use any
WORTH_TELLING = 0.01
_STRIP = 32  # rows whose median is taken at once


@dataclass(frozen=True)
class Plate:
    """What stands behind the person before one camera."""

    colours: Tensor  # (H, W, 3)
    known: Tensor  # (H, W) bool: seen without the person often enough


class OutlineLoss(Loss):
    """L1 and D-SSIM of the image; in masks and up to ``REACH`` px around them, before the plate
    where that is known.

    There the render's own opacity, not the mask, says how much of the plate is seen.
    """

    def __init__(
        self,
        photos: ImageLoader,
        plates: Mapping[int, Plate],
        behind: Tensor,
        ssim_weight: float,
        known: float,
    ) -> None:
        """Keep all of it.

        Args:
            photos: the training images as they were taken.
            plates: by the number of the camera.
            behind: (3,) colour of the run's background.
            known: fraction of the pixels near outlines where a plate is known, for people.
        """
        self._photos, self._plates, self._behind, self._ssim_weight = (
            photos,
            plates,
            behind,
            ssim_weight,
        )
        self.finding = (
            f"masks are found ones: {known:.0%} of the pixels at their outlines are compared before what other frames "
            "show behind the person"
        )

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        rendered = look.rendered
        truth = look.truth
        plate = self._plates.get(self._photos.views[look.index].camera_id)
        alpha = look.image.alpha
        if plate is not None and alpha is not None and truth.shape == plate.colours.shape:
            photo = self._photos[look.index].rgb_premultiplied
            colours, known, photo, behind = (
                sent(x, rendered.device) for x in (plate.colours, plate.known, photo, self._behind)
            )
            use = (known & _near(alpha))[..., None]
            seen = look.drawn.rendering.transmittance[0][..., None]
            rendered = rendered + use * seen * (colours - behind)
            truth = torch.where(use, photo, truth)
        return {"image": l1_ssim_loss(rendered, truth, self._ssim_weight, look.image.mask)}


def outline_loss(run: RunStart) -> OutlineLoss | None:
    """Return how colours are compared near outlines; None where masks come with the images, or no
    camera stands."""
    views = run.images.views
    config = run.config
    if (
        run.background == "random"
        or config.train.exposure != "never"
        or config.camera.refine == "always"
    ):
        return None
    if any(view.silhouette is None for view in views):
        return None
    photos = ImageLoader([replace(view, silhouette=None) for view in views], config.data)
    if photos[0].alpha is not None:
        return None
    plates: dict[int, Plate] = {}
    known = total = 0.0
    for camera, rows in _standing(views).items():
        shown = [rows[i] for i in evenly_spaced(len(rows), FRAMES)]
        near = torch.stack([_near(x) for i in shown if (x := run.images[i].alpha) is not None])
        plate = _plate(torch.stack([_bytes(photos[i].rgb_premultiplied) for i in shown]), near)
        if plate is None:
            continue
        plates[camera] = plate
        rims = near & ~torch.stack(
            [x > 1 - OUTSIDE for i in shown if (x := run.images[i].alpha) is not None]
        )
        known = known + float((rims & plate.known).sum())
        total = total + float(rims.sum())
    if not plates or known < WORTH_TELLING * total:
        return None
    return OutlineLoss(
        photos, plates, background_colour(run.background), config.train.ssim_weight, known / total
    )


def _standing(views: Sequence[View]) -> dict[int, list[int]]:
    """Return the rows of the views of each camera that stands, by its number."""
    rows: dict[int, list[int]] = defaultdict(list)
    for row, view in enumerate(views):
        rows[view.camera_id].append(row)

    def stands(own: list[int]) -> bool:
        first = views[own[0]]
        places = np.stack([views[i].cam_from_world for i in own])
        lenses = {(views[i].intrinsics.tobytes(), views[i].width, views[i].height) for i in own}
        return len(lenses) == 1 and np.allclose(places, first.cam_from_world, atol=1e-6)

    return {camera: own for camera, own in rows.items() if len(own) > SEEN_BARE and stands(own)}


def _near(alpha: Tensor) -> Tensor:
    """Return where (H, W) the mask is, and up to ``REACH`` px around it."""
    size = 2 * REACH + 1
    return torch.nn.functional.max_pool2d(alpha[None, None], size, 1, REACH)[0, 0] > OUTSIDE


def _bytes(rgb: Tensor) -> Tensor:
    return (255 * rgb).round().byte()


def _plate(photos: Tensor, near: Tensor) -> Plate | None:
    """Return the median of photos (F, H, W, 3) uint8 over those that show no person at a pixel.

    ``near`` (F, H, W) says where the person may be. None: it is not one thing, or never seen.
    """
    known = (~near).sum(0) >= SEEN_BARE
    colours = torch.zeros(*photos.shape[1:], device=photos.device)
    away = []
    for first in range(0, len(known), _STRIP):
        rows = slice(first, first + _STRIP)
        bare = (photos[:, rows] / 255).masked_fill(near[:, rows, :, None], torch.nan)
        colours[rows] = bare.nanmedian(0).values.nan_to_num()
        away.append((bare - colours[rows]).abs().amax(-1)[:, known[rows]].flatten())
    differences = torch.cat(away)
    differences = differences[~differences.isnan()]
    if not len(differences) or float(differences.median()) > STANDS:
        return None
    return Plate(colours, known)
