"""``dyngs train``: train a model from a capture."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import ProgressBar, print_lines
from dyngs.cli.view import add_serving_arguments, wait_for_interrupt
from dyngs.core.errors import DyngsError, format_count, quote_path

if TYPE_CHECKING:
    from dyngs.cli.training_progress import TrainingProgress
    from dyngs.config import Config
    from dyngs.training.events import Listener
    from dyngs.training.processes import Processes
    from dyngs.view.training import TrainingView

_EPILOG = """\
examples:
  dyngs train configs/static.yaml data.root=scans/bench
  dyngs train configs/static.yaml data.root=scans/bench train.steps=30000 run.dir=runs/bench run.threads=8
  dyngs train --resume runs/bench
  dyngs train --resume runs/bench train.steps=60000
  dyngs train configs/static.yaml data.root=scans/bench --view
  dyngs train configs/static.yaml data.root=scans/bench --from runs/bench init.trainable=colour run.dir=runs/recoloured
  torchrun --nproc-per-node 4 -m dyngs train configs/static.yaml data.root=scans/bench

CONFIG is a YAML file or the name of a packaged preset: static, blender, colmap, static_mcmc, mip, dynamic,
human, human_predictor. `dyngs config static` lists all keys.
"""
_LOGGING = tuple(
    f"train.{name}"
    for name in ("save_minutes", "save_every", "eval_every", "log_every", "tensorboard")
)
_FOR_THIS_CALL = ("run.threads", "run.device", "run.deterministic", "data.cache_mb", *_LOGGING)
"""Keys that do not change the result of a run."""
WITH_RESUME = ("train.steps", "data.root", "data.follow_links", *_FOR_THIS_CALL)
"""Keys that may be given with ``--resume``."""


def add_parser(commands: args.Commands) -> None:
    about = "Train a model from a capture. Writes a run folder (default runs/NAME)."
    parser = args.add_command(
        commands, "train", run, "train a model from a capture", about, _EPILOG
    )
    args.add_overrides(parser, "CONFIG key=value", "preset or YAML file, and overrides")
    resume = "continue an interrupted run, or with train.steps=N extend a run to N steps"
    parser.add_argument("--resume", type=args.input_path, metavar="RUN", help=resume)
    about = (
        "start from the Gaussians of a scene; init.trainable=colour or init.box freeze parts of it"
    )
    parser.add_argument(
        "--from", dest="begun", type=args.input_path, metavar="RUN|FILE", help=about
    )
    parser.add_argument(
        "--view", action="store_true", help="view the scene in a browser during training"
    )
    about = "with --view: end with the training (default: serve until Ctrl-C, on a terminal)"
    parser.add_argument("--close-viewer", action="store_true", help=about)
    add_serving_arguments(parser)
    args.add_run_device(parser)
    parser.set_defaults(takes_root=True)


def run(arguments: argparse.Namespace) -> int:
    """Train and print the next commands, in several processes if started by ``torchrun``."""
    if os.environ.get("WORLD_SIZE", "1") == "1":
        return _run(arguments)
    from dyngs.api.following import run_processes

    return run_processes(partial(_run, arguments))


def _run(arguments: argparse.Namespace, processes: Processes | None = None) -> int:
    """Train as rank 0 of ``processes``, or in a single process."""
    words = [*arguments.overrides, *args.run_device(arguments)]
    config = parse_config(words, arguments.resume, arguments.begun)
    args.computing_device(config.run.device)  # fails early without a GPU
    for option, is_given in (
        ("--port", arguments.port),
        ("--close-viewer", arguments.close_viewer),
    ):
        if is_given and not arguments.view:
            raise DyngsError(f"{option} requires --view")
    from dyngs.api.train import train
    from dyngs.cli.training_progress import TrainingProgress

    progress = TrainingProgress()
    listeners: list[Listener] = [progress]
    with ExitStack() as stack:
        view = None
        if arguments.view:
            view = stack.enter_context(_view(arguments, config, progress))
            listeners.append(view)
        with progress:
            folder = train(
                config,
                resume_from=arguments.resume,
                listeners=listeners,
                processes=processes,
                progress=ProgressBar,
            )
        _print_result(folder, config)
        if view is not None and sys.stdin.isatty() and not arguments.close_viewer:
            _keep_open(view)
    return 0


def _keep_open(view: TrainingView) -> None:
    """Serve the page of a finished training until Ctrl-C."""
    if view.link is None:
        return  # the run was finished before
    print(f"training finished; viewer open at {view.link}; Ctrl-C closes", flush=True)
    view.serve()
    wait_for_interrupt()


def _print_result(folder: Path, config: Config) -> None:
    """Print the run folder and the next commands."""
    for line in _about_motion(folder, config):
        print(line)
    word = quote_path(folder)
    print(f"trained: {folder}")
    from dyngs.models.kind import PredictsScenes, capability

    if capability(config.model, PredictsScenes) is not None:
        print(f"next:    dyngs predict {word} CAPTURE --out RUN")
    else:
        print(
            f"next:    dyngs eval {word}\n         dyngs render {word} --out "
            f"{quote_path(folder / 'images')}"
        )


def _view(
    arguments: argparse.Namespace, config: Config, progress: TrainingProgress
) -> TrainingView:
    """Return the listener that serves the page."""
    from dyngs.view.server import require_viser

    require_viser()
    from dyngs.view.server import ServerOptions
    from dyngs.view.training import TrainingView

    serving = ServerOptions(arguments.host, arguments.port)
    return TrainingView(config, serving, print_lines, lambda: progress.figures)


def _about_motion(folder: Path, config: Config) -> list[str]:
    """Return lines about the moving part of a dynamic model."""
    from dyngs.models.kind import HasMotion, capability
    from dyngs.runs.checkpoint import load_run

    if capability(config.model, HasMotion) is None:
        return []
    run = load_run(folder)
    scene = run.scene
    if capability(run.config.model, HasMotion) is None:
        return ["motion:  none, trained as a static scene"]
    if scene.is_static:
        return ["motion:  none, the scene is static"]
    return [
        f"motion:  {len(scene.rows):,} of {format_count(len(scene), 'Gaussian')} move "
        f"({scene.moving_fraction:.1%})"
    ]


def parse_config(words: Sequence[str], resume: Path | None, begun: Path | None = None) -> Config:
    """Return the configuration for the words after ``dyngs train`` and the path of ``--from``."""
    from dyngs.config.io import load_config, load_resolved

    if begun is not None and resume is not None:
        raise DyngsError("--from starts a new run, --resume continues a run: use one of them")
    if begun is not None:
        words = [*words, "init.kind=scene", f"init.scene={begun}"]
    has_preset = bool(words) and "=" not in words[0]
    preset, overrides = (Path(words[0]), words[1:]) if has_preset else (None, words)
    paths = [word for word in overrides if "=" not in word and Path(word).exists()]
    if paths:
        raise DyngsError(
            f"{paths[0]!r}: unexpected path; for a capture use data.root={quote_path(paths[0])}"
        )
    if resume is None:
        if not words:
            raise DyngsError(
                "a config is required, for instance `dyngs train static data.root=FOLDER`"
            )
        return load_config(preset, overrides)
    other = [word for word in words if word.partition("=")[0].strip() not in WITH_RESUME]
    if other:
        raise DyngsError(
            f"{other[0]!r}: the configuration of a run is fixed; --resume accepts train.steps=N, "
            f"data.root=FOLDER (a moved capture) and {', '.join(_FOR_THIS_CALL)}"
        )
    config = load_resolved(resume, overrides)
    return config.model_copy(update={"run": config.run.model_copy(update={"dir": resume})})
