"""``dyngs train``: train a model from a capture."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import ProgressBar, print_lines
from dyngs.cli.view import add_serving_arguments, wait_for_interrupt
from dyngs.core.errors import DyngsError, format_count, log_info, quote_path

if TYPE_CHECKING:
    from dyngs.cli.training_progress import TrainingProgress
    from dyngs.config import Config
    from dyngs.training.events import Listener
    from dyngs.training.processes import Processes
    from dyngs.view.training import TrainingView

_EPILOG = """\
examples:
  dyngs train scans/bench
  dyngs train clip.mp4 data.longest_side=480
  dyngs train mip scans/bench train.steps=30000 run.dir=runs/bench run.threads=8
  dyngs train --resume runs/bench
  dyngs train --resume runs/bench train.steps=60000
  dyngs train static scans/bench --view
  dyngs train static scans/bench --from runs/bench init.trainable=colour run.dir=runs/recoloured
  torchrun --nproc-per-node 4 -m dyngs train static scans/bench

PATH is a capture, a folder of photos or a video. PRESET is a YAML file or a name; `dyngs presets`
lists the names. Without PRESET, `static` is used for photos, `dynamic` for a video or a capture
with times, and `human` for a capture of a person. `dyngs config static` lists all keys.
"""
_RUN_KEYS = ("run.threads", "run.device", "run.deterministic", "data.cache_mb")
"""Keys that do not change the result of a run, besides those of logging."""


def add_parser(commands: args.Commands) -> None:
    about = "Train a model from a capture. Writes a run folder (default runs/CAPTURE-PRESET)."
    parser = args.add_command(
        commands, "train", run, "train a model from a capture", about, _EPILOG
    )
    about = "preset or YAML file, capture, and overrides"
    args.add_overrides(parser, "PRESET PATH key=value", about)
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
    from dyngs.models.kind import HasGaussians, PredictsScenes, capability

    if capability(config.model, PredictsScenes) is not None:
        print(f"next:    dyngs predict {word} CAPTURE --out RUN")
    else:
        print(f"next:    dyngs view {word}")
        if capability(config.model, HasGaussians) is not None:
            print(f"         dyngs export {word} --format html")
        print(f"         dyngs eval {word}")


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
    from dyngs.config.keys.train import LOGGING_KEYS

    if begun is not None and resume is not None:
        raise DyngsError("--from starts a new run, --resume continues a run: use one of them")
    preset, root, overrides = _split_words(words)
    if begun is not None:
        overrides = [*overrides, "init.kind=scene", f"init.scene={begun}"]
    if resume is None:
        if not words:
            raise DyngsError("a capture is required, for instance `dyngs train FOLDER`")
        if preset is None and root is not None:
            preset = "static" if begun is not None else _choose_preset(root, overrides)
        return load_config(preset, overrides)
    harmless = [*_RUN_KEYS, *(f"train.{key}" for key in LOGGING_KEYS)]
    allowed = ("train.steps", "data.root", "data.follow_links", *harmless)
    words = [*([preset] if preset else []), *overrides]
    other = [word for word in words if word.partition("=")[0].strip() not in allowed]
    if other:
        raise DyngsError(
            f"{other[0]!r}: the configuration of a run is fixed; --resume accepts train.steps=N, "
            f"data.root=FOLDER (a moved capture) and {', '.join(harmless)}"
        )
    config = load_resolved(resume, overrides)
    return config.model_copy(update={"run": config.run.model_copy(update={"dir": resume})})


def describe_option(option: str) -> str:
    """Return the message about an unknown option, with the key of the same meaning."""
    from dyngs.config.other_programs import key_of_option
    from dyngs.config.schema import config_keys

    name = option.lstrip("-").partition("=")[0].replace("-", "_")
    keys = dict.fromkeys(
        f"{key.name}=..." for key in config_keys() if f".{key.name}".endswith(f".{name}")
    )
    similar = key_of_option(option) or " or ".join(keys)
    hint = f"; use {similar}" if similar else "; settings are written as section.key=value"
    return f"unrecognized arguments: {option}{hint}"


def _split_words(words: Sequence[str]) -> tuple[str | None, Path | None, list[str]]:
    """Return the preset, the capture and the overrides, with ``data.root`` set to the capture.

    Raises DyngsError: a word that is none of these, or two of a kind.
    """
    names = [word for word in words if "=" not in word or Path(word).exists()]
    overrides = [word for word in words if word not in names]
    presets = [name for name in names if _is_preset(name)]
    paths = [_existing_capture(name) for name in names if name not in presets]
    given = [word for word in overrides if word.partition("=")[0].strip() == "data.root"]
    for what, found in (("preset", presets), ("capture", [*paths, *given])):
        if len(found) > 1:
            raise DyngsError(f"{str(found[1])!r}: a second {what}; give one preset and one capture")
    preset = presets[0] if presets else None
    if not paths:
        return preset, None, overrides
    return preset, paths[0], [f"data.root={paths[0].absolute()}", *overrides]


def _is_preset(name: str) -> bool:
    """Return whether a word is a YAML file, a file without suffix, or the name of a preset."""
    from dyngs.config.io import packaged_presets

    suffix = Path(name).suffix.lower()
    is_file = suffix in (".yaml", ".yml") or (not suffix and Path(name).is_file())
    return is_file or name.removeprefix("configs/") in packaged_presets()


def _existing_capture(name: str) -> Path:
    """Return the path of a capture. Raises DyngsError: no such path, a run, or another file."""
    from dyngs.config.io import RESOLVED_NAME, packaged_presets
    from dyngs.io.archive import is_archive
    from dyngs.io.outputs import VIDEO_SUFFIXES, suggest_command

    path = Path(name)
    if not path.exists():
        beside = path.parent.glob("*") if path.parent.is_dir() else ()
        close = get_close_matches(name, [*packaged_presets(), *map(str, beside)], n=2)
        hint = f"; did you mean {' or '.join(map(quote_path, close))}?" if close else ""
        raise DyngsError(f"{name}: no such preset (see `dyngs presets`) and no such path{hint}")
    if (path / RESOLVED_NAME).is_file():
        raise DyngsError(f"{name}: not a capture; {suggest_command(path)}")
    if path.is_file() and not is_archive(path) and path.suffix.lower() not in VIDEO_SUFFIXES:
        raise DyngsError(f"{name}: not a capture; give a folder, a video or a .zip")
    return path


def _choose_preset(root: Path, overrides: Sequence[str]) -> str:
    """Return the preset that fits the capture, and log it."""
    from dyngs.capture.preset import choose_preset
    from dyngs.config.io import load_config

    data = load_config(None, [word for word in overrides if word.startswith("data.")]).data
    preset, reason = choose_preset(data)
    log_info(
        f"preset {preset} ({reason}); for another one: `dyngs train PRESET {quote_path(root)}`, "
        "`dyngs presets` lists them"
    )
    return preset
