"""Evaluation of a run on a split, with the cameras refined by training."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import torch

from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.metrics import Lpips, LpipsNet, load_lpips, psnr
from dyngs.data.capture import Capture, View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.evaluate.view_scores import (
    FLIP_PIXELS,
    POSE_METRICS,
    REGION_METRICS,
    PoseScores,
    Regions,
    SceneRenderer,
    TimeScore,
    ViewScore,
    mean_scores,
    psnr_per_time,
    score_views,
    time_renders,
)
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.human.avatar.pose_fit import IMAGE_COMPARISON, SILHOUETTE_COMPARISON, fit_poses_to_images
from dyngs.human.avatar.scene import as_human_scene
from dyngs.io.write import write_text
from dyngs.models.checkpoint import CONFIG_ADVICE, read_run_capture
from dyngs.models.kind import HasMotion, capability
from dyngs.models.renderable import Renderable, run_path
from dyngs.models.views import evaluation_background
from dyngs.ops.device import CPU, select_device
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    LoadedRun,
    checkpoint_paths,
    has_only_scene_file,
    latest_checkpoint,
    load_run,
)
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.training.corrections.camera_refinement import (
    CameraCorrections,
    CameraRefinement,
    fit_camera_to_image,
)

SEE_THROUGH = 0.01
"""Fraction of see-through pixels of an object that is reported. Measured: avatars and solid scenes
0 to 0.0003, scenes trained on one background 0.03 to 0.06."""


def load_camera_corrections(
    run_dir: Path, run: LoadedRun, trained_on: Sequence[View]
) -> CameraCorrections | None:
    """Return the camera corrections of a run, or None if it refined no cameras or has no
    checkpoint."""
    if run.config.camera.refine != "always" or not checkpoint_paths(run_dir):
        return None
    checkpoint = latest_checkpoint(run_dir)
    refinement = CameraRefinement(trained_on, run.info.extent, run.config.train.steps)
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        refinement.load_state(checkpoint.part("cameras"))
    return refinement.corrections


def score_fitted_poses(
    drawing: SceneRenderer, images: ImageLoader, size: float, lpips: Lpips
) -> dict[str, Any]:
    """Return report fields for views whose poses were fitted to the images, with a fixed scene.

    Body poses are fitted for a person, camera poses otherwise. "silhouette_poses" are fitted to
    silhouettes only.

    Args:
        size: extent of the scene in world units.
    """
    background = drawing.background
    avatar = as_human_scene(drawing.scene)
    if avatar is not None:
        has_silhouettes = all(images[i].alpha is not None for i in range(len(images)))
        fields: dict[str, Any] = {}
        for name, comparison in (
            ("own_poses", IMAGE_COMPARISON),
            ("silhouette_poses", SILHOUETTE_COMPARISON),
        ):
            if name == "silhouette_poses" and not has_silhouettes:
                continue
            fitted, updates = fit_poses_to_images(avatar, images, background, comparison)
            each = (images[i] for i in range(len(images)))
            views, _ = score_views(fitted, each, drawing.options, background, lpips, flip_every=0)
            fields[name] = PoseScores(
                **mean_scores(views), updates=fmean(updates), per_view=tuple(views)
            )
        return fields | {"psnr_own_poses": fields["own_poses"].psnr}
    scene = require_gaussians(drawing.scene, "what cameras are fitted to")
    scores: list[float] = []
    for image in (images[i] for i in range(len(images))):
        cameras = fit_camera_to_image(scene, image, background, size)
        with torch.no_grad():
            rendering = scene.render(cameras, image.time, background=background)
        scores.append(psnr(rendering.rgb[0], image.composite(background), image.mask))
    return {"psnr_own_poses": fmean(scores)}


def load_split_images(
    capture: Capture, views: Sequence[View], run_dir: Path, run: LoadedRun
) -> ImageLoader:
    """Return the images of ``views``, a split of ``capture``, with the cameras refined by training.

    Views that were not trained on use the refined lens they share with training views, and the
    refined pose of a static camera. All other poses are those of the capture.
    """
    images = ImageLoader(views, run.config.data)
    corrections = load_camera_corrections(run_dir, run, capture.splits["train"])
    if corrections is not None:
        images.camera_correction = lambda index, cameras: corrections.correct_cameras(
            images.views[index], cameras
        )
    return images


@dataclass(frozen=True, kw_only=True)
class EvalReport:
    """Report that ``dyngs eval`` prints and writes. Field names are the keys of the JSON file."""

    split: str
    num_views: int
    # size of the first view in pixels
    width: int
    height: int
    background: str
    # means over views of the metrics in ``ViewScore``, None if a view has none
    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    lpips_net: str
    num_gaussians: int = 0
    num_moving: int = 0
    moving_fraction: float = 0.0
    # float32 parameters of Gaussians and deformation field in 1e6 bytes, without the 12 bytes per
    # Gaussian that a .ply adds
    model_mb: float
    field_mb: float = 0.0  # deformation field only
    # colour parameters per Gaussian, including its fraction of a colour network
    colour_floats: float = 0.0
    # inverse median time of deforming and rendering one view, after a warm-up
    fps: float
    deform_fraction: float  # median fraction of the time spent on deformation
    seconds_train: float
    step: int
    psnr_per_time: tuple[TimeScore, ...] = ()
    reasons: dict[str, str] = field(default_factory=dict)  # why a metric is None, by name
    notes: tuple[str, ...] = ()  # other remarks about the scores
    per_view: tuple[ViewScore, ...] = ()
    psnr_person: float | None = None
    ssim_person: float | None = None
    # file size of a run written by ``dyngs export --format dyngs``, else None
    stored_mb: float | None = None
    # means over the views that contain the region, see ``Regions``
    psnr_foreground: float | None = None
    psnr_moving: float | None = None
    psnr_static: float | None = None
    ssim_moving: float | None = None
    flip_moving: float | None = None
    # standard deviation over time of static pixels of fixed cameras, or of static sparse points
    # before others, in [0, 1]; None without these
    flicker_static: float | None = None
    flicker_static_images: float | None = None
    moving_from: str | None = None  # source of the moving region, None if unknown
    psnr_right: float | None = None
    psnr_right_fitted: float | None = None
    # from poses fitted to the evaluated images, None if not requested
    psnr_own_poses: float | None = None
    # None if images have no alpha
    psnr_white: float | None = None
    psnr_black: float | None = None
    ssim_black: float | None = None
    lpips_black: float | None = None
    see_through: float | None = None  # mean over views, see ``ViewScore``
    flip_views: int = 0  # number of views, evenly spaced, on which FLIP was computed
    own_poses: PoseScores | None = None
    silhouette_poses: PoseScores | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of the scene indicated by the scores."""
        if (self.see_through or 0) < SEE_THROUGH:
            return ()
        other = "black" if self.background == "white" else "white"
        return (
            f"{self.see_through:.0%} of the object is see-through, which shows with "
            f"`dyngs render RUN --out DIR --background {other}`; train with a higher "
            "train.alpha_weight",
        )

    def to_json(self) -> str:
        """Return the report as strict JSON (no NaN or Infinity) with a final newline."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"


def evaluate_run(
    run_dir: Path | str | Renderable,
    split: str = "test",
    *,
    lpips_net: LpipsNet = "alex",
    threads: int = 0,
    refine_poses: bool = False,
    device: str = "cpu",
    data_root: Path | None = None,
    capture: Capture | None = None,
    on_progress: ProgressCallback = ignore_progress,
) -> EvalReport:
    """Evaluate a run on one split and write the report to its folder.

    The file is ``metrics.json`` for the split "test", else ``metrics_SPLIT.json``.

    Example:

        import dyngs

        report = dyngs.evaluate("runs/lego")
        report.psnr, report.ssim, report.num_gaussians

    Args:
        run_dir: run folder, or the scene of one as it was trained or loaded.
        split: "test", "val", "train" or "pose".
        threads: number of torch threads from now on. 0 keeps it.
        refine_poses: also score with poses fitted to the evaluated images: body poses of a person,
            else camera poses. Always done for a run that refined its cameras.
        data_root: current folder of the capture, if it was moved.
        capture: capture of the run, in any coordinates. None reads it.
        on_progress: receives the number of scored views.
    """
    run_dir = run_path(run_dir)
    render_device = select_device(device)
    collect_inputs(run_dir).require_output(report_path(run_dir, split))
    if refine_poses and split == "train":
        raise DyngsError(
            f"{run_dir}: --refine needs images that were not trained on; use --split test, val or "
            "pose"
        )
    run = load_run(run_dir, data_root)
    capture = read_run_capture(run.config.data, run.info, capture)
    views = split_views(capture, split)
    background, colour = evaluation_background(run.config.data.background, capture.has_alpha)
    scene = scene_of_split(run, capture, split).to(render_device)
    drawing = SceneRenderer(scene, scene.options, colour.to(render_device))
    if threads:
        torch.set_num_threads(threads)
    loader = load_split_images(capture, views, run_dir, run)
    loader.device = render_device
    points = None if capture.points is None else capture.points.xyz
    regions = Regions(views, MotionMasks(capture, run.config.data), points)

    def images() -> Iterator[Image]:
        for index in range(len(loader)):
            on_progress("views", index, len(loader))
            yield loader[index]
        on_progress("views", len(loader), len(loader))

    lpips = load_lpips(lpips_net, render_device)
    num_pixels = len(loader) * loader[0].cameras.width * loader[0].cameras.height
    scores, reasons = score_views(
        scene,
        images(),
        drawing.options,
        drawing.background,
        lpips,
        regions,
        flip_every=math.ceil(num_pixels / FLIP_PIXELS),
    )
    fitted = {}
    if split != "train" and (refine_poses or run.config.camera.refine == "always"):
        fitted = score_fitted_poses(drawing, loader, run.info.extent, lpips)
    means = mean_scores(scores, MEAN_METRICS)
    reasons |= {name: regions.reason(name) for name in REGION_METRICS if means[name] is None}
    if means["psnr_right"] is None:
        reasons |= dict.fromkeys(
            ("psnr_right", "psnr_right_fitted"), "all pixels of one half of a view are masked"
        )
    report = EvalReport(
        split=split,
        num_views=len(scores),
        width=scores[0].width,
        height=scores[0].height,
        background=background,
        lpips_net=lpips_net,
        fps=1 / median(score.render_seconds for score in scores),
        deform_fraction=median(score.deform_seconds / score.render_seconds for score in scores),
        seconds_train=run.seconds_train,
        step=run.step,
        psnr_per_time=psnr_per_time((score.time, score.psnr) for score in scores),
        reasons=reasons,
        notes=_notes(run, scores),
        per_view=tuple(scores),
        flip_views=sum(score.flip is not None for score in scores),
        stored_mb=_stored_mb(run_dir),
        moving_from=regions.moving_from,
        **regions.flicker(),
        **means,
        **fitted,
        **_sizes(scene),
    )
    write_text(report_path(run_dir, split), report.to_json())
    return report


evaluate = evaluate_run
"""Its public name, ``dyngs.evaluate``."""


def held_out_psnr(
    run_dir: Path, capture: Capture, seconds: float, split: str = "test"
) -> tuple[float, int]:
    """Return the mean PSNR over views of a split in dB, and their number.

    Args:
        seconds: limit on the time. If too short for all views, as many as fit are rendered, evenly
            spaced.
    """
    begun = time.perf_counter()
    run = load_run(run_dir)
    device = select_device(run.config.run.device)
    views = split_views(capture, split)
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    scene = scene_of_split(run, capture, split).to(device)
    drawing = SceneRenderer(scene, scene.options, background.to(device))
    images = load_split_images(capture, views, run_dir, run)
    images.device = device

    def score(index: int) -> float:
        return _psnr(drawing, images[index])

    score(0)  # includes loading and compilation
    start = time.perf_counter()
    score(0)
    each = time.perf_counter() - start
    fitting = int((seconds - (start - begun)) / each)
    scores = [score(i) for i in evenly_spaced(len(views), max(fitting, 1))]
    known = [value for value in scores if math.isfinite(value)]
    return (fmean(known) if known else math.nan), len(known)


MEAN_METRICS = (
    *POSE_METRICS,
    "flip",
    "psnr_right",
    "psnr_right_fitted",
    "psnr_white",
    "see_through",
)
MEAN_METRICS += REGION_METRICS


def _sizes(scene: Renderable) -> dict[str, Any]:
    if not isinstance(scene, GaussianScene):
        values = sum(x.tensor.numel() for x in scene.drawing_state().values())
        return {"model_mb": 4e-6 * values}
    return {
        "num_gaussians": len(scene),
        "num_moving": 0 if scene.is_static else scene.num_moving,
        "moving_fraction": scene.moving_fraction,
        "model_mb": parameter_megabytes(scene),
        "field_mb": 4e-6 * scene.num_motion_values,
        "colour_floats": scene.num_colour_values / max(len(scene), 1),
    }


def _stored_mb(folder: Path) -> float | None:
    return 1e-6 * (folder / SCENE_FILE).stat().st_size if has_only_scene_file(folder) else None


def report_path(run_dir: Path, split: str) -> Path:
    """Return the path of the report of ``split`` in a run folder."""
    return run_dir / ("metrics.json" if split == "test" else f"metrics_{split}.json")


def parameter_megabytes(scene: GaussianScene) -> float:
    """Return the size of the parameters in 1e6 bytes.

    Counts float32 parameters of Gaussians (236 bytes at SH degree 3) and of the deformation field,
    and visibility masks as bits. SH coefficients of a Gaussian that are all zero beyond degree 0
    are not counted.
    """
    shapes = sum(x.numel() for name, x in scene.gaussians.tensors().items() if name != "sh")
    return (
        4e-6 * (shapes + scene.num_colour_values + scene.num_motion_values)
        + 1e-6 * scene.num_mask_bytes
    )


def _notes(run: LoadedRun, scores: Sequence[ViewScore]) -> tuple[str, ...]:
    notes = []
    if 0 < run.step < run.config.total_steps:
        notes.append(f"unfinished run: step {run.step:,} of {run.config.total_steps:,}")
    if run.config.data.background == "random":
        notes.append("trained with random backgrounds, evaluated on black")
    if capability(run.config.model, HasMotion) is not None and run.renderable.is_static:
        notes.append("dynamic model without motion: rendered as a static scene")
    if len({(s.width, s.height) for s in scores}) > 1:
        notes.append("views differ in size; width and height are those of the first view")
    return tuple(notes)


COMPARED_VIEWS = 20  # Most views compared per split: enough for a before/after comparison
ROUNDS = 3  # Renders of each view


@dataclass(frozen=True)
class RunMetrics:
    """Quality, size and speed of a run."""

    num_gaussians: int
    # means over at most ``COMPARED_VIEWS`` views, dB; None without the split
    psnr_train: float | None
    psnr_test: float | None
    fps: float  # inverse median time of deforming and rendering a view
    megabytes: float  # see ``parameter_megabytes``
    # file size in 1e6 bytes, for a run that consists of a scene file only
    stored: float | None = None


def compare_runs(
    folders: Sequence[Path], threads: int, device: torch.device = CPU, data_root: Path | None = None
) -> list[RunMetrics]:
    """Return the metrics of runs on the capture of the first run.

    Runs are rendered alternately, so that other load affects all equally.
    """
    runs = [load_run(folder, data_root) for folder in folders]
    data = runs[0].config.data
    capture = read_run_capture(data, runs[0].info)
    background = evaluation_background(data.background, capture.has_alpha)[1].to(device)
    psnrs: dict[str, list[float]] = {}
    seconds = np.zeros(0)
    with kernel_threads(threads), torch.no_grad():
        for split in ("train", "test") if capture.splits.get("test") else ("train",):
            loader = ImageLoader(split_views(capture, split), data)
            loader.device = device
            images = [loader[i] for i in evenly_spaced(len(loader), COMPARED_VIEWS)]
            drawings = []
            for run in runs:
                scene = scene_of_split(run, capture, split).to(device)
                drawings.append(SceneRenderer(scene, scene.options, background))
            psnrs[split] = [
                fmean(_psnr(drawing, image) for image in images) for drawing in drawings
            ]
            seconds = time_renders(drawings, images, ROUNDS)
    return [
        RunMetrics(
            num_gaussians=len(run.scene),
            psnr_train=psnrs["train"][i],
            psnr_test=psnrs["test"][i] if "test" in psnrs else None,
            fps=1 / float(np.median(seconds[i])),
            megabytes=parameter_megabytes(run.scene),
            stored=_stored_mb(folders[i]),
        )
        for i, run in enumerate(runs)
    ]


def _psnr(drawing: SceneRenderer, image: Image) -> float:
    truth = image.composite(drawing.background)
    return psnr(drawing.image(image.cameras, image.time), truth, image.mask)
