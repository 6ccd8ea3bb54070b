"""Whole jobs by one call each: train, evaluate, save and render a camera path."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from dyngs.api import train as training
from dyngs.api.load import load
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, load_resolved
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, log_info
from dyngs.core.metrics import LpipsNet
from dyngs.data.capture import Capture
from dyngs.evaluate.report import EvalReport, evaluate_run
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.images import OutputOptions, write_path_images
from dyngs.export.splat_files import (
    FOURDGS_SUFFIX,
    WriteOptions,
    write_4dgs,
    write_run_splats,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.models.kind import PredictsScenes, capability
from dyngs.models.renderable import Renderable
from dyngs.runs.opened import OpenedScene, open_scene, wrap_scene
from dyngs.training.events import Listener
from dyngs.training.losses import AddedLoss, LossFunction

Source = Path | str | Renderable
"""A run folder, or a scene that ``load`` or ``train`` returned."""
_AFTER_READING = {"root", "downscale", "longest_side", "background", "cache_mb", "follow_links"}
"""Keys of ``data`` that have an effect on a capture that was read already."""


def train(
    config: Config | Path | str | None = None,
    data: Capture | Mapping[str, Any] | Path | str | None = None,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    max_gaussians: int | None = None,
    longest_side: int | None = None,
    run_dir: Path | str | None = None,
    seed: int | None = None,
    threads: int | None = None,
    device: Literal["auto", "cpu", "cuda"] | None = None,
    resume: Path | str | None = None,
    losses: Sequence[LossFunction] = (),
    listeners: Sequence[Listener] = (),
    **keys: Any,
) -> GaussianScene:
    """Train a run and return its scene, which is also in the run folder ``scene.run.path``.

    Nothing is printed. Messages go to the logger ``dyngs``, events to ``listeners``.

    Example:

        import dyngs

        def prefer_dark(look):
            return 0.01 * look.rendered.mean()

        scene = dyngs.train(
            "static",
            data="lego",
            steps=2,
            run_dir="runs/dark",
            losses=[prefer_dark],
            init={"num_random": 50},
            **{"strategy.max_gaussians": 1000},
        )
        scene.run.path, scene.run.step

    Args:
        config: a ``Config``, a preset name or a YAML file; None: ``static``.
        data: folder, .zip or video (``data.root``), a ``Capture``, or the keys of the section.
        steps, minutes: ``train.steps`` and ``train.minutes``.
        max_gaussians: ``budget.max_gaussians``.
        longest_side: ``data.longest_side``, px.
        run_dir, seed, threads, device: the keys of the section ``run``.
        resume: a run folder to continue, up to ``steps`` if given. Pass ``losses`` and a changed
            ``Capture`` again. Its config is fixed.
        losses: functions of a ``dyngs.LossInput`` that return a differentiable scalar tensor,
            which is added to the loss of every step. Pilot runs are without them.
        listeners: functions of one event, see ``dyngs.training.events``.
        keys: any other configuration keys, by dotted name or as nested mappings.

    Raises:
        DyngsError: an unknown key, bad input, a folder that holds another run, or a budget that
            cannot be kept.
        KeyboardInterrupt: after Ctrl-C, once a checkpoint is saved; ``resume`` continues.
    """
    named = {
        "train.steps": steps,
        "train.minutes": minutes,
        "budget.max_gaussians": max_gaussians,
        "data.longest_side": longest_side,
        "run.dir": run_dir,
        "run.seed": seed,
        "run.threads": threads,
        "run.device": device,
    }
    changes = {name: value for name, value in named.items() if value is not None}
    capture = data if isinstance(data, Capture) else None
    if isinstance(data, Mapping):
        changes["data"] = data
    elif data is not None:
        changes["data.root"] = data if capture is None else capture.root
    added = [AddedLoss(function) for function in losses]
    names = [loss.name for loss in added]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise DyngsError(f"losses: two are named {twice[0]}; give functions of other names")
    if resume is not None:
        fixed = {*keys, *changes} - {"train.steps", "data.root", "run.threads", "run.device"}
        if config is not None or fixed:
            first = min(fixed, default="config")
            raise DyngsError(
                f"{first}: the configuration of a run is fixed; leave it out to resume"
            )
        resume = Path(resume)
        chosen = load_resolved(resume).replace({**changes, "run.dir": resume})
    else:
        changes |= {"train.losses": names} if names else {}
        changes |= keys
        is_config = isinstance(config, Config)
        chosen = config.replace(changes) if is_config else load_config(config or "static", changes)
    if capability(chosen.model, PredictsScenes) is not None:
        raise DyngsError(
            f"model.kind={chosen.model.kind}: trains a network, not a scene; use `dyngs train`"
        )
    usual = DataConfig(root=chosen.data.root).model_dump(exclude=_AFTER_READING)
    without_effect = [key for key, value in usual.items() if getattr(chosen.data, key) != value]
    if capture is not None and without_effect and resume is None:
        raise DyngsError(
            f"data.{without_effect[0]}: has no effect on a capture that was read already; give "
            "it to dyngs.read_capture in a DataConfig"
        )
    folder = training.train(
        chosen, resume_from=resume, listeners=listeners, capture=capture, losses=added
    )
    return load(folder)


def evaluate(
    run: Source,
    split: str = "test",
    *,
    capture: Capture | None = None,
    data: Path | str | None = None,
    lpips_net: LpipsNet = "alex",
    refine_poses: bool = False,
    threads: int = 0,
    device: str = "auto",
) -> EvalReport:
    """Evaluate a run on one split, and write the report to its folder.

    Example:

        import dyngs

        report = dyngs.evaluate("runs/lego")
        report.psnr, report.ssim, report.num_gaussians

    Args:
        run: its folder, or the scene as it was trained or loaded.
        split: "test", "val", "train" or "pose".
        capture: evaluate on this capture, instead of reading that of the run again.
        data: current folder of the capture, if it was moved.
        lpips_net: backbone of LPIPS, "alex" or "vgg".
        refine_poses: also score with poses that are fitted to the evaluated images.
        threads: number of torch threads from now on; 0: keep it.
        device: "auto", "cpu" or "cuda".

    Raises:
        DyngsError: no run, a capture that cannot be read, or a split without views.
    """
    return evaluate_run(
        run_folder(run),
        split,
        lpips_net=lpips_net,
        threads=threads,
        refine_poses=refine_poses,
        device=device,
        data_root=None if data is None else Path(data),
        capture=capture,
    )


def save(
    scene: GaussianScene | Gaussians,
    path: Path | str,
    *,
    time: float | None = None,
    sh_degree: int | None = None,
) -> Path:
    """Write a scene in memory as a file of Gaussians, in its own axes. Returns the path.

    ``dyngs.export`` writes runs, in more formats and with the axes that viewers expect.

    Example:

        import dyngs

        scene = dyngs.load("runs/lego")
        opaque = scene.gaussians.opacities > 0.1
        dyngs.save(scene.select(opaque), "opaque.ply")

    Args:
        scene: a scene, or Gaussians.
        path: the suffix selects the format; a .4dgs holds all times of a moving scene.
        time: in [0, 1], of a moving scene.
        sh_degree: highest degree in the file; None: that of the scene.

    Raises:
        DyngsError: an unknown suffix, no time of a moving scene, or a file that cannot be written.
    """
    path = Path(path)
    scene = StaticScene(gaussians=scene.detach()) if isinstance(scene, Gaussians) else scene
    opened = wrap_scene(scene)
    if path.suffix.lower() == FOURDGS_SUFFIX:
        _, notes = write_4dgs(opened, path, scene.times or (0.0,))
    elif time is None and not scene.is_static:
        raise DyngsError(f"{path}: the scene moves; give time=T, or a path in {FOURDGS_SUFFIX}")
    else:
        how = WriteOptions(sh_degree=sh_degree)
        notes = write_run_splats(opened, path, time or 0.0, how=how).notes
    for note in notes:
        log_info(note)
    return path


def render_path(
    scene: Source,
    path: Cameras | Path | str = "orbit",
    *,
    out: Path | str,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    times: float | Sequence[float] | None = None,
    fps: float | None = None,
    depth: bool = False,
    alpha: bool = False,
) -> list[Path]:
    """Render a camera path to images or to a video. Returns the written files.

    Example:

        import dyngs

        dyngs.render_path("runs/lego", "orbit", out="orbit", frames=4)

    Args:
        scene: a scene, a run folder or a file of Gaussians.
        path: "orbit", "spiral", "along" (the training cameras), a .json file of cameras, or
            ``Cameras`` in the coordinates of ``dyngs.load``.
        out: a folder of images, or a video by its suffix, such as .mp4.
        frames: number of frames of an automatic path; None: 120.
        size: width and height in px; None: that of the capture or of the cameras.
        times: scene time of all frames, or one per frame; None: 0 to 1 along the path.
        fps: frames per second of a video; None: 30, or that of the .json file.
        depth, alpha: also write these images.

    Raises:
        DyngsError: a path that needs the capture of a run, or a file that cannot be written.
    """
    opened = _opened(scene)
    moments = (times,) if isinstance(times, int | float) else times and tuple(times)
    options = PathOptions(path if isinstance(path, Cameras) else str(path), frames, size, moments)
    chosen = choose_path(opened, options)
    out = Path(out)
    video = out if out.suffix else None
    output = OutputOptions(depth, alpha, video, fps or chosen.fps)
    for note in (*opened.notes, *chosen.notes):
        log_info(note)
    return write_path_images(opened, chosen, None if video else out, output)


def run_folder(run: Source) -> Path:
    """Return the folder of a run. Raises DyngsError: a scene that is not as in its folder."""
    if not isinstance(run, Renderable):
        return Path(run)
    if run.run is None:
        raise DyngsError(
            "this scene is not that of a run folder, or was changed; give the run folder, or write "
            "the scene with dyngs.save"
        )
    return run.run.path


def _opened(scene: Source) -> OpenedScene:
    if isinstance(scene, Renderable) and scene.run is None:
        return wrap_scene(scene)
    return open_scene(run_folder(scene), nonfinite="skip")
