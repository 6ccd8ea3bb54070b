"""Masks of a person for captures that have none: the difference from what each fixed camera sees without them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dyngs.capture.background import Background, Separation, background_of, person_mask, separation
from dyngs.capture.multi_video.steadiness import steadiness
from dyngs.data.capture import Capture, Silhouette, View, all_views
from dyngs.data.images.images import area_downscale_uint8, read_image, target_size
from dyngs.data.readers.colmap import find_masks, mask_of
from dyngs.data.times import evenly_spaced
from dyngs.errors import DyngsError
from dyngs.files.write import write_image

SAMPLES = 41
"""Images of a camera whose median is the background."""
LEAST = 8
"""Least number of images of a camera."""
SIDE = 960
"""Longest side of the images that are compared, px."""
_ADVICE = "give masks of the person (--masks), or an image of the place without them (--background)"


@dataclass(frozen=True)
class _Camera:
    """Images of one fixed camera.

    Attributes:
        where: for messages.
        views: in order of time.
        size: width and height that the images are compared at.
    """

    where: str
    views: tuple[View, ...]
    size: tuple[int, int]

    def image(self, view: View) -> np.ndarray:
        """Return the image (H, W, 3) uint8 of a view at that size."""
        pixels = read_image(view.image_path, (view.width, view.height))[..., :3]
        return area_downscale_uint8(pixels, *self.size).numpy()


def with_background_masks(
    capture: Capture, folder: Path, empty: Path | None = None, say: Callable[[str], None] = print
) -> Capture:
    """Return the capture with masks of the person, written to ``folder``.

    Args:
        capture: of cameras that stand.
        folder: is made.
        empty: an image without the person, or a folder of one for each camera, whose name ends in the camera's number
            (or is that of any image of it); None: the median over time.
        say: is told in a line how well the person stands out.

    Raises:
        DyngsError: a camera that moves, too few images, or nobody who stands out; says what to add.
    """
    cameras = _fixed_cameras(capture)
    plates = {} if empty is None else _plates(empty, cameras)
    silhouettes: dict[str, Silhouette] = {}
    worst: Separation | None = None
    for index, camera in enumerate(cameras):
        sampled = np.stack([camera.image(camera.views[i]) for i in evenly_spaced(len(camera.views), SAMPLES)])
        background = _background(camera, sampled, plates.get(index))
        masks = np.stack([person_mask(background, image) for image in sampled])
        found = separation(background, sampled, masks)
        _require_clear(camera, found, with_plate=index in plates)
        worst = found if worst is None or found.on_edges < worst.on_edges else worst
        for view in camera.views:
            target = folder / f"{re.sub(r'[^A-Za-z0-9_-]', '_', view.name)}.{len(silhouettes):06d}.png"
            write_image(target, _at_size(person_mask(background, camera.image(view)), view))
            silhouettes[view.name] = Silhouette(target, "white")
    if worst is not None:
        say(
            f"masks by the difference from the background: {worst.on_edges:.0%} of the outlines lie on edges of the "
            f"images, the person differs by {worst.contrast:.0f} times the noise and covers {worst.area:.1%} of them"
        )
    splits = {
        name: tuple(replace(view, silhouette=silhouettes[view.name]) for view in views)
        for name, views in capture.splits.items()
    }
    return capture.replace(splits=splits, has_alpha=True)


def _fixed_cameras(capture: Capture) -> list[_Camera]:
    """Return the cameras of a capture, all of which stand.

    Raises:
        DyngsError: a camera that moves, or of which there are few images.
    """
    groups: dict[int, list[View]] = {}
    for view in all_views(capture.splits):
        groups.setdefault(view.camera_id, []).append(view)
    cameras = []
    for number, views in sorted(groups.items()):
        where = f"{capture.root}, camera {number}"
        first = views[0]
        same = all(
            np.allclose(view.cam_from_world, first.cam_from_world, atol=1e-6)
            and (view.width, view.height) == (first.width, first.height)
            for view in views
        )
        if not same:
            raise DyngsError(
                f"{where} moves, so there is no background to compare with; give masks of the person (--masks)"
            )
        if len(views) < LEAST:
            raise DyngsError(f"{where}: has {len(views)} images, too few for a background; {_ADVICE}")
        views.sort(key=lambda view: (view.time or 0.0, view.name))
        cameras.append(_Camera(where, tuple(views), target_size(first.width, first.height, 1.0, SIDE)))
    return cameras


def _plates(empty: Path, cameras: Sequence[_Camera]) -> Mapping[int, Path]:
    """Return the images without the person, by index of the camera.

    Raises:
        DyngsError: no such file, or none for a camera.
    """
    if empty.is_file():
        if len(cameras) > 1:
            raise DyngsError(f"{empty}: is one image for {len(cameras)} cameras; give a folder with one each")
        return {0: empty}
    files = find_masks(empty) if empty.is_dir() else {}
    if not files:
        raise DyngsError(f"{empty}: no image of the background there")
    numbers = {int(found[1]): path for name, path in files.items() if (found := re.search(r"(\d{1,9})\D*$", path.stem))}
    plates = {}
    for index, camera in enumerate(cameras):
        named = (mask_of(f"{view.name}{view.image_path.suffix}", files) for view in camera.views)
        path = next((path for path in named if path is not None), numbers.get(camera.views[0].camera_id))
        if path is None:
            raise DyngsError(f"{empty}: no background for {camera.where}; call it {camera.views[0].camera_id}.png")
        plates[index] = path
    return plates


def _background(camera: _Camera, sampled: np.ndarray, plate: Path | None) -> Background:
    """Return what the camera sees without the person.

    Raises:
        DyngsError: the camera moves, or the image of the background has another shape.
    """
    if plate is not None:
        first = camera.views[0]
        pixels = read_image(plate, (first.width, first.height))[..., :3]
        height, width = pixels.shape[:2]
        if abs(width * first.height - height * first.width) > max(first.width, first.height):
            raise DyngsError(
                f"{plate}: is {width}x{height}, images of its camera {first.width}x{first.height}; take it with the "
                "same camera"
            )
        if width < camera.size[0]:
            raise DyngsError(f"{plate}: is smaller than the images; take it with the same camera")
        colours = area_downscale_uint8(pixels, *camera.size).numpy().astype(np.float32)
        spread = background_of(sampled).noise
        return Background(colours, np.full_like(spread, float(np.median(spread))))
    moved = steadiness(sampled[..., 1])
    if not moved.stands:
        raise DyngsError(
            f"{camera.where}: the camera moves, so there is no background to compare with; give masks of the person "
            "(--masks)"
        )
    return background_of(sampled)


def _require_clear(camera: _Camera, found: Separation, *, with_plate: bool) -> None:
    """Refuse masks that cannot be trusted.

    Raises:
        DyngsError: says why, and what to add.
    """
    if found.is_clear if not with_plate else found.area > 0 and found.on_edges > 0.5:
        return
    if found.area < 1e-3:
        raise DyngsError(f"{camera.where}: nobody stands out from the background; {_ADVICE}")
    raise DyngsError(
        f"{camera.where}: the person never leaves their place, so that the background there is not seen "
        f"({found.staying:.0%} of the masks are where somebody is most of the time, {found.on_edges:.0%} of their "
        f"outlines on edges); {_ADVICE}"
    )


def _at_size(mask: np.ndarray, view: View) -> np.ndarray:
    """Return the mask as grey levels (H, W, 1) uint8 at the size of the view's image, bilinear."""
    values = torch.from_numpy(mask.astype(np.float32))[None, None]
    sized = torch.nn.functional.interpolate(values, (view.height, view.width), mode="bilinear", align_corners=False)
    return (sized[0, 0, :, :, None] * 255).round().to(torch.uint8).numpy()
