"""Search for the coarsest quantisation of a trained scene whose error on images of its capture
stays below a limit."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import contributions
from dyngs.gaussians.scene import GaussianScene, render_options, restore_scene
from dyngs.models.checkpoint import Checkpoint, read_run_capture, restore_model
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background, training_cameras
from dyngs.runs.stored_file import (
    COARSENESS,
    LIMIT,
    MAX_COARSENESS,
    TRIANGLES,
    choose_coding,
    decode_scene,
    encode_scene,
    round_step_down,
    round_trip,
    step_group,
    tensors_to_store,
    to_checkpoint_tensors,
)

GREY_LEVELS = 255.0
TRIALS = 4  # number of steps tried per group
CLOSE = 0.8  # fraction of the allowed error from which the search ends
FIRST_STEP = 2.0**-6  # first step as a fraction of the mean magnitude of the values
WIDEST_JUMP = 32.0
OUTLYING, USUAL_FRACTION = 64.0, 0.95
"""Outliers, which are ignored when steps are chosen: values above this multiple of this quantile of
the nonzero values."""
MOST_VISIBLE = 0.9  # quantile of visibility above which Gaussians are stored most finely
ASSUMED_STEPS = {
    "quats": 2**-8,
    "log_scales": 2**-6,
    "logit_opacities": 2**-10,
    "sh_base": 2**-7,
    "sh_rest": 2**-7,
}

Draw = Callable[[Mapping[str, Tensor]], Sequence[Tensor]]
"""Images (H, W, 3), always from the same cameras at the same times, of a checkpoint's tensors."""


@dataclass(frozen=True)
class Precision:
    """Quantisation steps and the change of images that they cause."""

    steps: dict[str, float]  # of each group of tensors; 0: it is stored as it is
    # root mean square change of the images, grey levels of 255; None where none could be drawn
    change: float | None = None
    allowed: float | None = None  # what it was to be at most; None likewise


def compute_coarseness(visibility: Tensor) -> Tensor:
    """Return (N,) uint8 octaves by which each Gaussian may be stored more coarsely than the most
    visible ones.

    An error of a Gaussian counts with the square of its weight in the images: half an octave per
    octave. ``visibility``: (N,) sums of its blending weights over images.
    """
    if not len(visibility):
        return torch.zeros(0, dtype=torch.uint8, device=visibility.device)
    most = torch.quantile(
        visibility[:: max(len(visibility) // 2**20, 1)].double(), MOST_VISIBLE
    ).clamp_min(1e-30)
    octaves = -0.5 * (visibility.double() / most).clamp(1e-30, 1.0).log2()
    return octaves.round().clamp_max(MAX_COARSENESS).to(torch.uint8)


def default_precision(gaussians: Gaussians) -> Precision:
    """Return steps where no image can be drawn: fine ones; those of positions follow the size of
    the Gaussians."""
    log_scales = gaussians.log_scales.detach().double()
    size = float(log_scales.median(1).values.median().exp()) if len(log_scales) else 1.0
    return Precision(
        {f"gaussians.{name}": step for name, step in ASSUMED_STEPS.items()}
        | {"gaussians.means": size / 64}
    )


def measure_precision(
    exact: Mapping[str, Tensor],
    wanted: Sequence[Tensor],
    draw: Draw,
    max_change: float,
    on_progress: ProgressCallback = ignore_progress,
) -> Precision:
    """Return the largest steps found that change the images by at most ``max_change``, grey levels
    of 255.

    ``exact``: from ``tensors_to_store``, with the coarseness of the Gaussians if they have any;
    ``draw`` renders such tensors. Raises DyngsError: a value is not finite.
    """

    def change(steps: Mapping[str, float], names: Iterable[str] = exact) -> float:
        """Return the mean square over all values in [0, 1], with the tensors of these names
        quantised; NaN where an image is."""
        drawn = draw(to_checkpoint_tensors(quantize_tensors(exact, steps, names)))
        total = sum(
            float((x.clamp(0, 1) - y.clamp(0, 1)).double().square().sum())
            for x, y in zip(wanted, drawn, strict=True)
        )
        return total / max(sum(x.numel() for x in wanted), 1)

    allowed = (max_change / GREY_LEVELS) ** 2
    groups: dict[str, dict[str, Tensor]] = {}
    for name, x in exact.items():
        group = step_group(name, x)
        if group is not None and x.numel():
            groups.setdefault(group, {})[name] = x
    sizes = {name: sum(x.numel() for x in group.values()) for name, group in groups.items()}
    steps: dict[str, float] = {}
    enough: dict[str, float] = {}
    for name, group in groups.items():
        on_progress("measuring precision, parameters", len(steps), len(groups) + 1)
        steps[name], is_enough = _largest_step(
            lambda step, name=name, group=group: change({name: step}, group),
            list(group.values()),
            allowed * sizes[name] / sum(sizes.values()),
        )
        enough[name] = steps[name] if is_enough else 0.0
    on_progress("measuring precision, parameters", len(groups), len(groups) + 1)
    for tried in (steps, enough):
        kept, found = _scaled(tried, change, allowed)
        if found <= allowed:
            break
    else:
        kept = dict.fromkeys((*groups, *exact), 0.0)
        found = change(kept)
    on_progress("measuring precision, parameters", len(groups) + 1, len(groups) + 1)
    return Precision(kept, math.sqrt(found) * GREY_LEVELS, max_change)


def quantize_tensors(
    exact: Mapping[str, Tensor], steps: Mapping[str, float], names: Iterable[str]
) -> dict[str, Tensor]:
    """Return the tensors with those of ``names`` as a file with these steps holds them.

    ``exact``: from ``tensors_to_store``, and the coarseness of the Gaussians if they have any.
    ``names``: of the tensors that are rounded.
    """
    coarseness = exact[COARSENESS].numpy() if COARSENESS in exact else None
    found = dict(exact)
    for name in names:
        coding = choose_coding(name, exact[name], steps, by_coarseness=coarseness is not None)
        found[name] = round_trip(exact[name], coding, coarseness)
    return found


def _scaled(
    steps: dict[str, float], change: Callable[[Mapping[str, float]], float], allowed: float
) -> tuple[dict[str, float], float]:
    """Return all steps times one factor, so that together they change the images by what is allowed
    or less.

    And the mean square change that they make, which is larger only where no factor that was tried
    is small enough.
    """
    best = None
    tried = steps
    found = math.inf
    factor = 1.0
    for trial in range(2 * TRIALS):
        tried = {name: step and round_step_down(factor * step) for name, step in steps.items()}
        found = change(tried)
        if found <= allowed and (best is None or found > best[1]):
            best = (tried, found)
        if best is not None and (trial >= TRIALS or found > CLOSE * allowed):
            break
        if math.isnan(found):
            break
        factor *= min(max(math.sqrt(0.95 * allowed / max(found, 1e-300)), 0.5), 2.0)
    return (tried, found) if best is None else best


def _largest_step(
    change: Callable[[float], float], group: Sequence[Tensor], allowed: float
) -> tuple[float, bool]:
    """Return the largest step tried that changes images by at most ``allowed``, else the finest;
    and whether it does.

    The first one tried where these images do not depend on the group at all: others may.
    """
    size, mean_square = _usual_size(torch.cat([x.flatten() for x in group]))
    if size == 0:
        return 1.0, True
    finest = 2 * size / LIMIT
    coarsest = 4 * size
    step = first = min(max(FIRST_STEP * math.sqrt(mean_square), finest), coarsest)
    best = None
    for _ in range(TRIALS):
        step = round_step_down(min(max(step, finest), coarsest))
        found = change(step)
        if math.isnan(found):
            return finest, False
        if found <= allowed:
            best = max(best or 0.0, step)
            if found > CLOSE**2 * allowed or step >= coarsest / 2:
                break
        step *= min(
            max(math.sqrt(0.9 * allowed / max(found, 1e-300)), 1 / WIDEST_JUMP), WIDEST_JUMP
        )
    if best is None:
        return finest, change(round_step_down(finest)) <= allowed
    return round_step_down(first) if best >= coarsest / 2 else best, True


def _usual_size(values: Tensor) -> tuple[float, float]:
    """Return the largest of the values without outliers, and the mean of their squares."""
    sizes = values.abs().double()
    nonzero = sizes[sizes > 0]
    if not len(nonzero):
        return 0.0, 0.0
    usual = nonzero.kthvalue(max(int(USUAL_FRACTION * len(nonzero)), 1)).values
    sizes = sizes[sizes <= OUTLYING * usual]
    return float(sizes.max()), float(sizes.square().mean())


LOSS_DB = 0.025
"""Allowed loss of PSNR on training images, dB. On others it is up to twice as much."""
# of triangles: places as they are, all else in half precision
_ASSUMED = Precision({TRIANGLES: 0.0})
COMPARED = 6  # number of training views in which the change is measured
SMALLEST_CHANGE = 0.01  # smallest change to allow, in grey levels of 255
LOOKED_AT = 50  # number of training views in which the visibility of each Gaussian is measured

# factors on the usual steps that are tried, by bisection
FACTORS = tuple(2 ** (k / 2) for k in range(-6, 9))

Shot = tuple[Cameras, float | None]
"""Camera and time of one training image."""


def plan_storage(
    config: Config,
    checkpoint: Checkpoint,
    scene: Renderable,
    max_change: float | None,
    on_progress: ProgressCallback = ignore_progress,
) -> tuple[Precision, Tensor | None]:
    """Return how exactly ``scene`` must be stored, and the coarseness (N,) uint8 of its Gaussians,
    measured where the run's capture can be read.

    ``checkpoint``: of ``scene``. ``max_change``: root mean square over all values of some training
    images, grey levels of 255. None: what lowers their PSNR by ``LOSS_DB``, if it is independent of
    the scene's own errors.
    """
    try:
        capture = read_run_capture(config.data, checkpoint.info)
    except DyngsError:
        assumed = isinstance(scene, GaussianScene) and default_precision(scene.gaussians)
        return assumed or _ASSUMED, None
    coarseness = None
    if isinstance(scene, GaussianScene):
        coarseness = compute_coarseness(
            _visibility(scene, _shots(config, capture, scene, LOOKED_AT))
        )
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    shots = _shots(config, capture, scene, COMPARED)
    info = checkpoint.info
    options = scene.options
    if isinstance(scene, GaussianScene):
        options = render_options(config.model, info.extent, info.world_scale)

    @torch.no_grad()
    def images(drawn: Renderable) -> list[Tensor]:
        return [
            drawn.render(camera, time, options=options, background=background).rgb[0]
            for camera, time in shots
        ]

    def redrawn(tensors: Mapping[str, Tensor]) -> list[Tensor]:
        return images(restore_model(replace(checkpoint, tensors=dict(tensors)), config.model))

    wanted = images(scene)
    if max_change is None:
        loader = ImageLoader(_chosen(capture, COMPARED), config.data)
        truth = (loader[i].composite(background) for i in range(len(loader)))
        errors = [
            float((x.clamp(0, 1) - y).square().mean()) for x, y in zip(wanted, truth, strict=True)
        ]
        max_change = GREY_LEVELS * math.sqrt((10 ** (LOSS_DB / 10) - 1) * fmean(errors))
    exact = tensors_to_store(scene) | ({} if coarseness is None else {COARSENESS: coarseness})
    most = max(max_change, SMALLEST_CHANGE)
    return measure_precision(exact, wanted, redrawn, most, on_progress), coarseness


def find_coarsest_file(
    config: Config, checkpoint: Checkpoint, quality: Callable[[GaussianScene], float], least: float
) -> tuple[bytes, float] | None:
    """Return the bytes of a file with the coarsest steps tried at which ``quality`` is at least
    ``least``, and that quality; None: it never is.

    All steps are those that ``storage_plan`` measures, times one factor. The bytes are read again
    before they count. ``quality``: of a scene, the higher the better.
    """
    scene = restore_scene(checkpoint, config.model)
    precision, coarseness = plan_storage(config, checkpoint, scene, None)
    best = None

    def is_too_coarse(factor: float) -> bool:
        nonlocal best
        steps = {
            name: step and round_step_down(factor * step) for name, step in precision.steps.items()
        }
        data = encode_scene(checkpoint.info, scene, steps, coarseness)
        found = quality(restore_scene(decode_scene(data), config.model))
        if found >= least:
            best = data, found
        return found < least

    bisect_left(FACTORS, True, key=is_too_coarse)
    return best


def _shots(config: Config, capture: Capture, scene: Renderable, count: int) -> list[Shot]:
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
    return list(zip(cameras, times, strict=True))


def _chosen(capture: Capture, count: int) -> list[View]:
    views = capture.splits["train"]
    count = min(count, len(views))
    return [views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)]


def _visibility(scene: GaussianScene, shots: Sequence[Shot]) -> Tensor:
    scene = scene.without_masks()
    total = torch.zeros(len(scene), device=scene.gaussians.means.device)
    for camera, time in shots:
        total += contributions(scene.at(time), camera, scene.options)[0]
    return total
