"""A finished run as one small file, and what that does to its pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from dyngs.build import training_cameras
from dyngs.camera import Cameras
from dyngs.config import Config
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.data.capture import Capture, View
from dyngs.data.loader import PictureLoader
from dyngs.data.read import read_capture
from dyngs.deform.trained import TrainedScene
from dyngs.errors import DyngsError
from dyngs.evaluate.report import render_options
from dyngs.rendering import RenderOptions, contributions
from dyngs.runs.checkpoint import COMPACT_NAME, Checkpoint, latest_checkpoint, stored_scene
from dyngs.runs.folder import folder_of_export
from dyngs.scene import Scene, moment_of
from dyngs.storage.drawable import LEARNED, drawable
from dyngs.storage.file import SceneInfo, decoded, encoded, write_scene
from dyngs.storage.precision import (
    GREY_LEVELS,
    Draw,
    Precision,
    assumed_precision,
    coarseness_of,
    mean_square_change,
    measured_precision,
)
from dyngs.storage.tensors import COARSENESS
from dyngs.train.background import evaluation_background

LOSS_DB = 0.025
"""By how much the PSNR of training pictures may fall. That of others falls by up to twice as much."""
COMPARED = 6
"""Training views in which the change is measured."""
SMALLEST_CHANGE = 0.01
"""Grey levels of 255; less is of no use."""
MISSED = 1.05
"""A file whose pictures change by so many times what is allowed is not written; less is rounding of the drawing."""
LOOKED_AT = 50
"""Training views in which it is measured how much each Gaussian shows."""


@dataclass(frozen=True)
class CompactRun:
    """What was written.

    Attributes:
        path: of the file.
        precision: steps, and how much the pictures change.
        num_bytes: of the file.
        num_bytes_exact: of the same tensors before, 4 bytes per value.
    """

    path: Path
    precision: Precision
    num_bytes: int
    num_bytes_exact: int


@dataclass(frozen=True)
class _Shot:
    """What one training picture shows: a camera and a time."""

    cameras: Cameras
    time: float | None


def write_compact(run_dir: Path, out: Path, max_change: float | None = None, field_step: float = 1.0) -> CompactRun:
    """The file in the folder ``out``, with the run's ``config.yaml`` beside it: together a run that can be drawn.

    Args:
        run_dir: a run with a checkpoint.
        out: a folder, made where it is missing; it may be the run's own, or hold a former export of that run.
        max_change: root mean square over all values of some training pictures, grey levels of 255. None: what lowers
            their PSNR by ``LOSS_DB``, if it is independent of the model's own errors.
        field_step: how many times as coarsely as that the field is rounded.

    Raises:
        DyngsError: no such run, ``out`` holds another one, the pictures would change by more than ``max_change``, or
            the file cannot be written. Nothing is written then.
    """
    config = load_resolved(run_dir)
    with folder_of_export(out, run_dir, config) as folder:
        checkpoint = latest_checkpoint(run_dir)
        tensors, precision, draw = _precision(config, checkpoint, max_change)
        steps = {name: step * (field_step if name.startswith(LEARNED) else 1) for name, step in precision.steps.items()}
        data = encoded(SceneInfo(**asdict(checkpoint.info)), tensors, config.model, steps)
        if draw is not None and precision.allowed is not None and field_step == 1:
            precision = _checked(run_dir, precision, draw(checkpoint.tensors), draw(decoded(data).tensors))
        write_scene(folder / COMPACT_NAME, data)
        if out.resolve() != run_dir.resolve():
            save_config(config, folder / RESOLVED_NAME)
    return CompactRun(out / COMPACT_NAME, precision, len(data), num_bytes_exact(checkpoint))


def _checked(run_dir: Path, precision: Precision, before: Sequence[Tensor], after: Sequence[Tensor]) -> Precision:
    """The precision with the change from the pictures ``before`` to those of the file.

    Raises:
        DyngsError: it is more than what is allowed.
    """
    change = GREY_LEVELS * math.sqrt(mean_square_change(before, after))
    if precision.allowed is not None and not change <= MISSED * precision.allowed:
        raise DyngsError(
            f"{run_dir}: stored in little space, pictures would change by {change:.2g} grey levels of 255, more "
            f"than the {precision.allowed:.2g} allowed; nothing was written. Give a larger --max-change"
        )
    return replace(precision, change=change)


def precision_of(
    config: Config, checkpoint: Checkpoint, max_change: float | None
) -> tuple[dict[str, Tensor], Precision]:
    """The tensors to store and how exactly: measured where the run's capture can be read."""
    tensors, precision, _ = _precision(config, checkpoint, max_change)
    return tensors, precision


def _precision(
    config: Config, checkpoint: Checkpoint, max_change: float | None
) -> tuple[dict[str, Tensor], Precision, Draw | None]:
    """As ``precision_of``, and what draws the pictures that were compared; None where there are none."""
    try:
        capture = read_capture(config.data)
    except DyngsError:
        return checkpoint.tensors, assumed_precision(checkpoint.tensors), None
    scene = stored_scene(checkpoint, config.model)
    options = render_options(config.model)
    visibility = _visibility(scene, _shots(config, capture, scene, LOOKED_AT), options)
    tensors = checkpoint.tensors | {COARSENESS: coarseness_of(visibility)}
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    shots = _shots(config, capture, scene, COMPARED)

    def draw(state: Mapping[str, Tensor]) -> list[Tensor]:
        drawn = stored_scene(replace(checkpoint, tensors=dict(state)), config.model)
        moments = (moment_of(drawn, shot.time) for shot in shots)
        with torch.no_grad():
            return [
                moment.seen_by(shot.cameras, options, background).rgb[0]
                for moment, shot in zip(moments, shots, strict=True)
            ]

    if max_change is None:
        pictures = PictureLoader(_chosen(capture, COMPARED), config.data)
        truth = (pictures[i].composite(background) for i in range(len(pictures)))
        errors = [float((x.clamp(0, 1) - y).square().mean()) for x, y in zip(draw(tensors), truth, strict=True)]
        max_change = GREY_LEVELS * math.sqrt((10 ** (LOSS_DB / 10) - 1) * fmean(errors))
    return tensors, measured_precision(tensors, draw, max(max_change, SMALLEST_CHANGE)), draw


def num_bytes_exact(checkpoint: Checkpoint) -> int:
    """Bytes of what drawing needs of a checkpoint, as it is there."""
    return sum(x.numel() * x.itemsize for x in drawable(checkpoint.tensors).values())


def _shots(config: Config, capture: Capture, scene: Scene, count: int) -> list[_Shot]:
    """At most ``count`` training views, evenly chosen; where they have no times, those of the scene."""
    chosen = _chosen(capture, count)
    times: Sequence[float | None] = [view.time for view in chosen]
    if scene.times and None in times:
        times = [scene.times[(2 * i + 1) * len(scene.times) // (2 * len(chosen))] for i in range(len(chosen))]
    cameras = training_cameras(chosen, config.data)
    return [_Shot(camera, time) for camera, time in zip(cameras, times, strict=True)]


def _chosen(capture: Capture, count: int) -> list[View]:
    """At most ``count`` training views, evenly chosen."""
    views = capture.splits["train"]
    count = min(count, len(views))
    return [views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)]


def _visibility(scene: Scene, shots: Sequence[_Shot], options: RenderOptions) -> Tensor:
    """(N,) sums of blending weights over the pictures."""
    scene = scene.unmasked() if isinstance(scene, TrainedScene) else scene
    total = torch.zeros(len(scene))
    for shot in shots:
        total += contributions(scene.at(shot.time), shot.cameras, options)[0]
    return total
