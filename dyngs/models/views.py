"""Cameras, times and background of a capture, as training and evaluation need them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.core.camera import Cameras
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import scaled_intrinsics
from dyngs.data.loader import Image
from dyngs.data.read import view_size

_BACKGROUNDS = {"white": 1.0, "black": 0.0}
OPAQUE = 0.99  # Alpha from which a pixel shows no background
ALIKE = 0.1  # Largest difference of a channel up to which a colour counts as that of the background


def background_coloured_fraction(images: Iterable[Image], background: Tensor) -> float | None:
    """Return the fraction of the opaque pixels whose channels all differ from ``background`` (3,)
    by ``ALIKE`` or less.

    None where there are no opaque pixels next to a background. Masked pixels do not count.
    """
    opaque, alike, shows_background = 0, 0, False
    for image in images:
        if image.alpha is None:
            continue
        shows_background |= bool((image.alpha < OPAQUE).any())
        counts = image.alpha >= OPAQUE
        if image.mask is not None:
            counts &= image.mask > 0
        colours = image.rgb_premultiplied[counts] / image.alpha[counts][:, None]
        opaque += len(colours)
        alike += int(((colours - background).abs() <= ALIKE).all(1).sum())
    return alike / opaque if opaque and shows_background else None


def evaluation_background(choice: str, has_alpha: bool) -> tuple[str, Tensor]:
    """Return the name and (3,) colour of the background to evaluate on: black where that of
    training was random."""
    resolved = {"auto": "white" if has_alpha else "black", "random": "black"}.get(choice, choice)
    return resolved, torch.full((3,), _BACKGROUNDS[resolved], device="cpu")


def background_colour(name: str, generator: torch.Generator | None = None) -> Tensor:
    """Return the (3,) colour of a "white", "black" or "random" background; a random one without
    generator is black."""
    if name == "random" and generator is not None:
        return torch.rand(3, generator=generator, device="cpu")
    return torch.full((3,), _BACKGROUNDS["black" if name == "random" else name], device="cpu")


def resolve_background(config: Config, capture: Capture) -> str:
    """Return "white", "black" or "random"; "auto" is white where images have alpha, as in 3DGS,
    else black."""
    if config.data.background == "auto":
        return "white" if capture.has_alpha else "black"
    return config.data.background


def training_cameras(views: Sequence[View], options: DataConfig) -> list[Cameras]:
    """Return the cameras of ``views`` as images of their training size, one each; no image is
    read."""
    cameras = []
    for view in views:
        width, height = view_size(view, options)
        intrinsics = scaled_intrinsics(view.intrinsics, width / view.width, height / view.height)
        pose = torch.from_numpy(view.cam_from_world).float()
        cameras.append(
            Cameras(pose[None], torch.from_numpy(intrinsics).float()[None], width, height)
        )
    return cameras


def training_times(capture: Capture) -> tuple[float, ...]:
    """Return the times of the training views in [0, 1], ascending; empty without times."""
    return tuple(sorted(view.time for view in capture.splits["train"] if view.time is not None))
