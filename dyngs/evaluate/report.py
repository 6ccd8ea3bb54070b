"""Measures a finished run on held-out views and writes the report beside it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean, median
from typing import Any, cast

import torch

from dyngs.data.capture import Capture, Split, View, all_views
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.true_tracks import read_true_tracks
from dyngs.errors import DyngsError
from dyngs.evaluate.own_poses import PoseRefinement, images_of_split, scores_from_own_poses
from dyngs.evaluate.regions import RegionName, Regions
from dyngs.evaluate.temporal import Drawing, TimeScore, flicker_error, flicker_of_split, psnr_per_time
from dyngs.evaluate.tracks import TrackScores, track_scores
from dyngs.evaluate.view_scores import PoseScores, ViewScore, mean_of, means_of, score_views
from dyngs.files.write import write_text
from dyngs.gaussians.scene import Scene
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.motion.captured import captured_motion, same_bodies
from dyngs.metrics import LpipsNet, MetricValue, load_lpips
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background, training_cameras
from dyngs.ops.device import device_for
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, has_only_scene_file, load_run

REGION_METRICS: dict[str, RegionName] = {
    "psnr_foreground": "foreground",
    "psnr_moving": "moving",
    "psnr_static": "still",
}
"""Metrics of regions: their names, and the regions."""


@dataclass(frozen=True)
class EvalReport:
    """The report that ``dyngs eval`` prints and writes; the fields are the keys of the file (docs/formats.md).

    Attributes:
        split: which views.
        num_views, width, height: how many, and the size of the first in pixels.
        background: name of the colour behind images and renders, "white" or "black".
        psnr, ssim, flip, lpips: means over the views of the per-view values.
        lpips_net: backbone that LPIPS uses, or would use.
        num_gaussians: N.
        num_moving, moving_fraction: M and M / N.
        model_mb: float32 parameters of all Gaussians and of the field in 1e6 bytes; an exported .ply adds 12 bytes per
            Gaussian.
        field_mb: of these, the field's.
        colour_floats: numbers per Gaussian that its colour takes, with its fraction of a network.
        fps: one over the median time of drawing one view, after a warm-up: deformation and rendering; loading and
            metrics not counted.
        deform_fraction: median fraction of that time that the deformation takes.
        psnr_per_time: mean PSNR at each distinct time; empty for a still capture.
        flicker, flicker_error: see ``dyngs.evaluate.temporal``.
        seconds_train, step: how long and how far the run was trained.
        reasons: metric name to why it is None.
        notes: anything else that a reader of the numbers should know.
        per_view: the single views.
        stored_mb: size on disk of a run that ``dyngs export --format dyngs`` wrote; None of others.
        psnr_person, ssim_person: means inside the box around the person, where the true image is not transparent;
            only of a human model, and None where images have no alpha.
        psnr_black, ssim_black, lpips_black: means of the whole image on black, as published figures of people have
            it; None in the same cases.
        psnr_foreground, psnr_moving, psnr_static: means over the views that have such a region, see
            ``dyngs.evaluate.regions``.
        moving_from: how it was found what moves, None where it was not.
        psnr_right, psnr_right_fitted: means of the PSNR of right halves, as the scene shows them, and after an affine
            colour fitted on left halves, see ``dyngs.evaluate.half_fit``; None where a half has no pixel that counts.
        track_error_px, track_within_5px, track_motion_px: see ``dyngs.evaluate.tracks``.
        psnr_own_poses: PSNR from poses refined on the images themselves, of cameras (``dyngs.evaluate.own_poses``)
            or of the body (``dyngs.human.avatar.pose_fit``); None where that was not asked for.
        own_poses: of a person, all scores from these poses.
        silhouette_poses: of a person, all scores from poses fitted to the silhouettes of these images alone.
    """

    split: str
    num_views: int
    width: int
    height: int
    background: str
    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None
    lpips_net: str
    num_gaussians: int
    num_moving: int
    moving_fraction: float
    model_mb: float
    field_mb: float
    colour_floats: float
    fps: float
    deform_fraction: float
    seconds_train: float
    step: int
    flicker: float | None = None
    flicker_error: float | None = None
    psnr_per_time: tuple[TimeScore, ...] = ()
    reasons: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    per_view: tuple[ViewScore, ...] = ()
    psnr_person: float | None = None
    ssim_person: float | None = None
    stored_mb: float | None = None
    psnr_foreground: float | None = None
    psnr_moving: float | None = None
    psnr_static: float | None = None
    moving_from: str | None = None
    track_error_px: float | None = None
    track_within_5px: float | None = None
    track_motion_px: float | None = None
    psnr_right: float | None = None
    psnr_right_fitted: float | None = None
    psnr_own_poses: float | None = None
    psnr_black: float | None = None
    ssim_black: float | None = None
    lpips_black: float | None = None
    own_poses: PoseScores | None = None
    silhouette_poses: PoseScores | None = None

    def to_json(self) -> str:
        """Return the report as strict JSON (no NaN or Infinity), ending in a newline."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"


def evaluate_run(
    run_dir: Path,
    split: str = "test",
    *,
    lpips_net: LpipsNet = "alex",
    threads: int = 0,
    refine_poses: bool = False,
    device: str = "cpu",
    capture: Capture | None = None,
) -> EvalReport:
    """Return the report of a run on one split and write it into its folder: ``metrics.json``, ``metrics_SPLIT.json``.

    Args:
        run_dir: folder of a run with at least one checkpoint.
        split: "test", "val", "train" or "pose".
        lpips_net: "alex", "vgg" or "squeeze".
        threads: for rendering and metrics; 0 leaves the number as it is.
        refine_poses: also score from poses, of a person's body, otherwise of the cameras, that were refined on the
            images themselves; always done for a run that refined its cameras.
        device: "auto", "cpu" or "cuda": draws the views, and compares images, but for FLIP.
        capture: of the run, if it was read already.

    Raises:
        DyngsError: no such run or split, unreadable images, a render or metric that is not finite, unwritable folder,
            poses of training views that are to be refined, no GPU that can be used.
    """
    draws_on = device_for(device)
    _require_untrained(run_dir, split, refine_poses)
    run = load_run(run_dir)
    capture = capture or read_capture(run.config.data)
    views = split_views(capture, split)
    background, colour = evaluation_background(run.config.data.background, capture.has_alpha)
    scene = scene_of_split(run, capture, split).to(draws_on)
    drawing = Drawing(scene, scene.options, colour.to(draws_on))
    with _num_threads(threads):
        loader = images_of_split(capture, views, run_dir, run)
        loader.device = draws_on
        regions = Regions(views, loader, drawing.background)
        images, lpips = (loader[i] for i in range(len(loader))), load_lpips(lpips_net, draws_on)
        scores, reasons = score_views(scene, images, drawing.options, drawing.background, lpips, regions)
        temporal = _temporal(drawing, loader, views)
        tracks = _track_scores(run, capture, scene, views)
        asked = split != "train" and (refine_poses or run.config.camera.refine == "always")
        fitted = scores_from_own_poses(drawing, loader, run.info.extent, lpips) if asked else PoseRefinement()
    reasons |= {name: measured.reason for name, measured in temporal.items() if measured.reason is not None}
    report = EvalReport(
        split=split,
        num_views=len(scores),
        background=background,
        flip=mean_of([s.flip for s in scores]),
        lpips_net=lpips_net,
        psnr_per_time=psnr_per_time((s.time, s.psnr) for s in scores),
        reasons=reasons,
        notes=_notes(run, scores),
        per_view=tuple(scores),
        **_own_poses(fitted),
        **{name: measured.value for name, measured in temporal.items()},
        **means_of(scores),
        **_facts(run_dir, run, scene),
        **_sizes_and_speed(scores),
    )
    return _written(run_dir, _with_parts(report, regions, tracks))


def _written(run_dir: Path, report: EvalReport) -> EvalReport:
    write_text(report_path(run_dir, report.split), report.to_json())
    return report


def _require_untrained(run_dir: Path, split: str, refine_poses: bool) -> None:
    if refine_poses and split == "train":
        raise DyngsError(
            f"{run_dir}: --refine is for images that were not trained on; name them with --split test, val or pose"
        )


def _own_poses(fitted: PoseRefinement) -> dict[str, Any]:
    """Return the fields of a report on refined poses."""
    return {
        "psnr_own_poses": fitted.psnr,
        "own_poses": fitted.to_images,
        "silhouette_poses": fitted.to_silhouettes,
    }


def _facts(run_dir: Path, run: LoadedRun, scene: Renderable) -> dict[str, Any]:
    """Return the fields of a report that no image is needed for."""
    facts = {
        "seconds_train": run.seconds_train,
        "step": run.step,
        "stored_mb": 1e-6 * (run_dir / SCENE_FILE).stat().st_size if has_only_scene_file(run_dir) else None,
    }
    if not isinstance(scene, Scene):
        values = sum(x.tensor.numel() for x in scene.drawing_state().values())
        none = {"num_gaussians": 0, "num_moving": 0, "moving_fraction": 0.0, "field_mb": 0.0, "colour_floats": 0.0}
        return facts | none | {"model_mb": 4e-6 * values}
    return facts | {
        "num_gaussians": len(scene),
        "num_moving": 0 if scene.is_static else scene.num_moving,
        "moving_fraction": scene.moving_fraction,
        "model_mb": parameter_megabytes(scene),
        "field_mb": 4e-6 * scene.num_motion_values,
        "colour_floats": scene.num_colour_values / max(len(scene), 1),
    }


def _sizes_and_speed(scores: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the size of the first image, and how fast all were drawn."""
    return {
        "width": scores[0].width,
        "height": scores[0].height,
        "fps": 1 / median(s.render_seconds for s in scores),
        "deform_fraction": median(s.deform_seconds / s.render_seconds for s in scores),
    }


def _with_parts(report: EvalReport, regions: Regions, tracks: TrackScores) -> EvalReport:
    """Return the report with the means of the regions' metrics, and the errors of tracks."""
    reasons: dict[str, str] = {}
    means: dict[str, float | None] = {}
    for metric, region in REGION_METRICS.items():
        known = [value for value in (getattr(view, metric) for view in report.per_view) if value is not None]
        means[region] = fmean(known) if known else None
        if not known:
            reasons[metric] = regions.reason(region)
    right, fitted = (
        mean_of([getattr(x, name) for x in report.per_view]) for name in ("psnr_right", "psnr_right_fitted")
    )
    if right is None:
        reasons["psnr_right"] = reasons["psnr_right_fitted"] = "half a view has no pixel that counts"
    if tracks.reason is not None:
        reasons["track_error_px"] = tracks.reason
    return replace(
        report,
        psnr_foreground=means["foreground"],
        psnr_moving=means["moving"],
        psnr_static=means["still"],
        psnr_right=right,
        psnr_right_fitted=fitted,
        moving_from=regions.moving_from,
        track_error_px=tracks.error_px,
        track_within_5px=tracks.within_5px,
        track_motion_px=tracks.motion_px,
        reasons=report.reasons | reasons,
    )


def report_path(run_dir: Path, split: str) -> Path:
    """Return the path of the report of ``split`` in a run folder."""
    return run_dir / ("metrics.json" if split == "test" else f"metrics_{split}.json")


def split_views(capture: Capture, split: str) -> Sequence[View]:
    """Return the views of a split, at least one. Raises DyngsError that lists the splits there are."""
    views = {name: views for name, views in capture.splits.items() if views}
    for name, found in views.items():
        if name == split:
            return found
    there = ", ".join(f"{name} ({len(found)} views)" for name, found in views.items())
    raise DyngsError(f"{capture.root}: the split {split!r} has no views; there is {there or 'none'}")


def scene_of_split(run: LoadedRun, capture: Capture, split: str) -> Renderable:
    """Return the scene of a run as the views of ``split`` show it: a person plays the clip of that split.

    The split pose, and splits with body parameters of their own, have the poses of their files. Others show the clip of
    training with its refined poses, interpolated at times between.
    """
    avatar = avatar_of(run.renderable)
    if avatar is None or capture.body is None:
        return run.renderable
    given, trained = capture.body[cast(Split, split)], capture.body["train"]
    if split != "pose" and same_bodies(given, trained):
        return run.renderable
    shown = captured_motion(capture.root, given, split_views(capture, split), avatar.skeleton.joints)
    return avatar.playing(shown.clip)


def _temporal(drawing: Drawing, loader: ImageLoader, views: Sequence[View]) -> dict[str, MetricValue]:
    """Return the flicker of a split, and the error of its changes in time."""
    return {
        "flicker": flicker_of_split(drawing, loader, views),
        "flicker_error": flicker_error(drawing, loader, views),
    }


def _track_scores(run: LoadedRun, capture: Capture, scene: Renderable, views: Sequence[View]) -> TrackScores:
    """Return the errors of the scene's motion where the capture has true tracks."""
    tracks = read_true_tracks(capture.root, capture.world_offset)
    cameras = training_cameras(views, run.config.data)
    if not isinstance(scene, Scene):
        return TrackScores(reason="it is not made of Gaussians, whose tracks could be compared")
    return track_scores(scene, tracks, list(zip(views, cameras, strict=True)), all_views(capture.splits))


def parameter_megabytes(scene: Scene) -> float:
    """Return the size in 1e6 bytes as float32: 236 bytes per Gaussian at SH degree 3, the field, and masks as bits.

    Harmonics of a Gaussian that are all zero beyond the base colour do not count.
    """
    shapes = sum(x.numel() for name, x in scene.gaussians.tensors().items() if name != "sh")
    return 4e-6 * (shapes + scene.num_colour_values + scene.num_motion_values) + 1e-6 * scene.num_mask_bytes


def _notes(run: LoadedRun, scores: Sequence[ViewScore]) -> tuple[str, ...]:
    """Return notes on how to read the numbers."""
    notes = []
    if run.step < run.config.total_steps:
        notes.append(
            f"the run is not finished: it stands at step {run.step:,} of {run.config.total_steps:,}, and its schedules "
            "where they were then"
        )
    if run.config.data.background == "random":
        notes.append("trained on random backgrounds, evaluated on black")
    if run.config.model.may_move and run.renderable.is_static:
        notes.append("the model is dynamic, but nothing moves in it: it is drawn as fast as a static one")
    if len({(s.width, s.height) for s in scores}) > 1:
        notes.append("views differ in size; width and height are those of the first")
    return tuple(notes)


@contextmanager
def _num_threads(threads: int) -> Iterator[None]:
    """Run the block with ``threads`` threads (0 = as they are)."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
