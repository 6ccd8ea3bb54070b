"""Storage precision of a trained scene, measured on images of its capture, and the coarsest file
that will do."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.compress.precision import (
    GREY_LEVELS,
    Precision,
    assumed_precision,
    coarseness_of,
    measured_precision,
    rounded,
)
from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.gaussians.rendering import contributions
from dyngs.gaussians.restored import restored_model, restored_scene
from dyngs.gaussians.scene import GaussianScene, render_options
from dyngs.models.checkpoint import Checkpoint, read_capture_of
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background, training_cameras
from dyngs.runs.stored_file import decoded, encoded
from dyngs.runs.stored_tensors import COARSENESS, TRIANGLES, completed, drawable, step_below

LOSS_DB = 0.025
"""Allowed loss of PSNR on training images, dB. On others it is up to twice as much."""
# of triangles: places as they are, all else in half precision
_ASSUMED = Precision({TRIANGLES: 0.0})
COMPARED = 6  # number of training views in which the change is measured
SMALLEST_CHANGE = 0.01  # smallest change to allow, in grey levels of 255
LOOKED_AT = 50  # number of training views in which the visibility of each Gaussian is measured

# factors on the usual steps that are tried, by bisection
FACTORS = tuple(2 ** (k / 2) for k in range(-6, 9))

Images = Callable[[Renderable], list[Tensor]]
"""Draws a scene, always from the same cameras at the same times: (H, W, 3) each."""


@dataclass(frozen=True)
class StoragePlan:
    """Precision and coarseness with which a scene is stored."""

    precision: Precision  # steps, and how much the images change
    coarseness: Tensor | None = None  # (N,) uint8 of the Gaussians, or None
    images: Images | None = None  # draws what was compared; None where no image can be drawn


@dataclass(frozen=True)
class _Shot:
    """Camera and time of one training image."""

    cameras: Cameras
    time: float | None


def storage_plan(
    config: Config, checkpoint: Checkpoint, scene: Renderable, max_change: float | None
) -> StoragePlan:
    """Return how exactly ``scene`` must be stored: measured where the run's capture can be read.

    ``checkpoint``: of ``scene``. ``max_change``: root mean square over all values of some training
    images, grey levels of 255. None: what lowers their PSNR by ``LOSS_DB``, if it is independent of
    the scene's own errors.
    """
    try:
        capture = read_capture_of(config.data, checkpoint.info)
    except DyngsError:
        return StoragePlan(
            assumed_precision(scene.gaussians) if isinstance(scene, GaussianScene) else _ASSUMED
        )
    coarseness = None
    if isinstance(scene, GaussianScene):
        coarseness = coarseness_of(_visibility(scene, _shots(config, capture, scene, LOOKED_AT)))
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    shots = _shots(config, capture, scene, COMPARED)
    info = checkpoint.info
    options = scene.options
    if isinstance(scene, GaussianScene):
        options = render_options(config.model, info.extent, info.world_scale)

    @torch.no_grad()
    def images(drawn: Renderable) -> list[Tensor]:
        return [
            drawn.render(shot.cameras, shot.time, options=options, background=background).rgb[0]
            for shot in shots
        ]

    def redrawn(tensors: Mapping[str, Tensor]) -> list[Tensor]:
        return images(restored_model(replace(checkpoint, tensors=dict(tensors)), config.model))

    wanted = images(scene)
    if max_change is None:
        loader = ImageLoader(_chosen(capture, COMPARED), config.data)
        truth = (loader[i].composite(background) for i in range(len(loader)))
        errors = [
            float((x.clamp(0, 1) - y).square().mean()) for x, y in zip(wanted, truth, strict=True)
        ]
        max_change = GREY_LEVELS * math.sqrt((10 ** (LOSS_DB / 10) - 1) * fmean(errors))
    exact = drawable(scene) | ({} if coarseness is None else {COARSENESS: coarseness})
    return StoragePlan(
        measured_precision(exact, wanted, redrawn, max(max_change, SMALLEST_CHANGE)),
        coarseness,
        images,
    )


@dataclass(frozen=True)
class CoarseFile:
    """A file in memory."""

    data: bytes  # its bytes
    factor: float  # on the usual steps
    quality: float  # of the scene that is read from it
    refused: float | None  # quality at the next coarser steps; None where none were tried


def coarsest_file(
    config: Config, checkpoint: Checkpoint, quality: Callable[[GaussianScene], float], least: float
) -> CoarseFile | None:
    """Return the file with the coarsest steps tried at which ``quality`` is at least ``least``;
    None: it never is.

    All steps are those that ``storage_plan`` measures, times one factor. The bytes are read again
    before they count. ``quality``: of a scene, the higher the better.
    """
    scene = restored_scene(checkpoint, config.model)
    plan = storage_plan(config, checkpoint, scene, None)
    exact = drawable(scene) | ({} if plan.coarseness is None else {COARSENESS: plan.coarseness})

    def drawn(tensors: dict) -> GaussianScene:
        return restored_scene(Checkpoint(checkpoint.info, tensors), config.model)

    def steps(factor: float) -> dict[str, float]:
        return {
            name: step and step_below(factor * step) for name, step in plan.precision.steps.items()
        }

    low = 0
    high = len(FACTORS)
    refused = None
    while low < high:
        middle = (low + high) // 2
        found = quality(drawn(completed(rounded(exact, steps(FACTORS[middle])))))
        if found >= least:
            low = middle + 1
        else:
            refused, high = found, middle
    for index in range(low - 1, -1, -1):
        data = encoded(checkpoint.info, scene, steps(FACTORS[index]), plan.coarseness)
        found = quality(drawn(decoded(data).tensors))
        if found >= least:
            return CoarseFile(data, FACTORS[index], found, refused)
        refused = found
    return None


def _shots(config: Config, capture: Capture, scene: Renderable, count: int) -> list[_Shot]:
    """Return at most ``count`` training views, evenly chosen; where they have no times, those of
    the scene."""
    chosen = _chosen(capture, count)
    times: Sequence[float | None] = [view.time for view in chosen]
    if scene.times and None in times:
        times = [
            scene.times[(2 * i + 1) * len(scene.times) // (2 * len(chosen))]
            for i in range(len(chosen))
        ]
    cameras = training_cameras(chosen, config.data)
    return [_Shot(camera, time) for camera, time in zip(cameras, times, strict=True)]


def _chosen(capture: Capture, count: int) -> list[View]:
    views = capture.splits["train"]
    count = min(count, len(views))
    return [views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)]


def _visibility(scene: GaussianScene, shots: Sequence[_Shot]) -> Tensor:
    scene = scene.unmasked()
    total = torch.zeros(len(scene), device=scene.gaussians.means.device)
    for shot in shots:
        total += contributions(scene.at(shot.time), shot.cameras, scene.options)[0]
    return total
