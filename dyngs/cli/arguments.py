"""Arguments and their types that several commands share."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from dyngs.cli.output import print_notes
from dyngs.core.errors import DyngsError

if TYPE_CHECKING:
    import torch

    from dyngs.config import DataConfig
    from dyngs.runs.opened import OpenedScene

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
AXES = ("x", "y", "z", "-x", "-y", "-z")
_DEVICES = ("auto", "cpu", "cuda")


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    help: str,
    description: str | None = None,
    epilog: str | None = None,
) -> argparse.ArgumentParser:
    """Add a command that ``run`` carries out; return its parser."""
    formatter = argparse.HelpFormatter if epilog is None else argparse.RawDescriptionHelpFormatter
    parser = commands.add_parser(
        name, help=help, description=description, epilog=epilog, formatter_class=formatter
    )
    parser.set_defaults(run=run)
    return parser


# ---------------------------------------------------------------------------------------------------- types


def input_path(text: str) -> Path:
    """Type of an argument that names what a command reads."""
    return Path(text)


def input_word(text: str) -> str:
    """Type of an argument that names what a command reads, or something else, as a preset."""
    return text


def output_path(text: str) -> Path:
    """Type of an argument that names what a command writes."""
    return Path(text)


def integer_type(what: str, low: int, high: int, more: str = "") -> Callable[[str], int]:
    """Return the type of an argument that is a whole number; ``what`` is its name with an article,
    for messages."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < 10 and low <= int(text) <= high):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {what}; write a whole number from {low} to {high:,}{more}"
            )
        return int(text)

    return parse


def scene_time(text: str) -> float:
    """Return a finite time; values outside [0, 1] are clamped later, with a warning."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a time; write a number from 0 to 1, for instance 0.5"
        )
    return time


def image_size(text: str) -> tuple[int, int]:
    """Return width and height from ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    if not match or "0" in match.groups():
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size; write WIDTHxHEIGHT, for instance 1280x720"
        )
    return int(match[1]), int(match[2])


# ---------------------------------------------------------------------------------------------------- arguments


def add_threads(parser: argparse.ArgumentParser) -> None:
    kind = integer_type("a number of threads", 0, 1024, ", 0 for all cores")
    parser.add_argument(
        "--threads", type=kind, default=0, metavar="N", help="number of threads, 0 = all cores"
    )


def add_device(parser: argparse.ArgumentParser, default: str = "auto") -> None:
    about = f"what computes; auto: a CUDA GPU that can be used, else the CPU (default {default})"
    parser.add_argument("--device", choices=_DEVICES, default=default, help=about)


def add_run_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--device`` to a command that trains: it sets ``run.device``."""
    parser.add_argument(
        "--device", choices=_DEVICES, help="what computes, as run.device=... (default auto)"
    )


def run_device(arguments: argparse.Namespace) -> list[str]:
    """Return the override that ``--device`` of ``add_run_device`` means."""
    return [] if arguments.device is None else [f"run.device={arguments.device}"]


def add_json(parser: argparse.ArgumentParser) -> None:
    about = "print the result as JSON on stdout, all else on stderr"
    parser.add_argument("--json", action="store_true", help=about)


def add_split(
    parser: argparse._ActionsContainer, about: str = "default test", default: str | None = "test"
) -> None:
    parser.add_argument(
        "--split", choices=("test", "val", "train", "pose"), default=default, help=about
    )


def add_up(parser: argparse.ArgumentParser, of: str = "") -> None:
    """Add ``--up``, the axis that is up in the scene."""
    usual = "default: up for the cameras of a run; of a file what it says, or what is usual for its format"
    parser.add_argument("--up", choices=AXES, help=f"up axis{of} ({usual})")


def add_motion(parser: argparse._ActionsContainer) -> None:
    about = "motion for a person: .npz (AMASS, SMPL-X), .bvh, .glb, .gltf, .vrma"
    parser.add_argument("--motion", type=input_path, metavar="FILE", help=about)


def add_keep_feet(parser: argparse.ArgumentParser) -> None:
    about = "of --motion: move the person along the floor so that feet that touch it do not slide"
    parser.add_argument("--keep-feet", action="store_true", help=about)


def require_motion_for_feet(arguments: argparse.Namespace) -> None:
    """Raise DyngsError for ``--keep-feet`` without ``--motion``."""
    if arguments.keep_feet and arguments.motion is None:
        raise DyngsError(
            "--keep-feet goes with --motion FILE: it is about feet in a motion; add one, or leave it out"
        )


def play_motion(arguments: argparse.Namespace, opened: OpenedScene) -> OpenedScene:
    """Return the person in ``--motion``, or all as it is without; print what was found of its
    feet."""
    if arguments.motion is None:
        return opened
    moved = opened.play_motion(arguments.motion, keep_feet=arguments.keep_feet)
    print_notes(moved.notes[len(opened.notes) :])
    return replace(moved, notes=opened.notes)


def add_overrides(parser: argparse.ArgumentParser, metavar: str, about: str) -> None:
    parser.add_argument("overrides", nargs="*", default=[], metavar=metavar, help=about)


def add_data_root(parser: argparse.ArgumentParser) -> None:
    """Add the overrides of a command that reads the capture of a run."""
    about = "where the capture of the run lies by now; data.follow_links=true: its files may lie elsewhere"
    add_overrides(parser, "data.root=FOLDER", about)
    parser.set_defaults(takes_root=True)


def data_root(arguments: argparse.Namespace) -> Path | None:
    """Return the folder of ``add_data_root``; None: the capture was not moved. Raises DyngsError:
    another word."""
    found = None
    for word in arguments.overrides:
        key, equals, value = word.partition("=")
        if word in ("data.follow_links=true", "data.follow_links=false"):
            continue
        if key.strip() != "data.root" or not equals or not value.strip():
            raise DyngsError(
                f"{word!r}: the run keeps its own configuration; only data.root=FOLDER, where its capture was moved "
                "to, and data.follow_links=true may be given"
            )
        found = Path(value.strip())
    return found


def follows_links(overrides: Sequence[str]) -> bool:
    """Return whether overrides say that files of captures may lie outside their folders."""
    from dyngs.config.yaml_reader import read_override

    leaves = [
        leaf
        for word in overrides
        if word.startswith("data") and "=" in word
        for leaf in read_override(word)
    ]
    return any(leaf.keys == ("data", "follow_links") and leaf.value == "true" for leaf in leaves)


def data_section(overrides: list[str], capture_format: str = "auto") -> DataConfig:
    """Return the data section with overrides ``data.key=value``; its root has no meaning."""
    from dyngs.config.io import load_config

    for word in overrides:
        if not word.startswith("data.") or word.startswith(("data.root=", "data.format=")):
            raise DyngsError(f"{word!r}: give keys of data here, such as data.follow_links=true")
    return load_config(None, ["data.root=.", f"data.format={capture_format}", *overrides]).data


# ---------------------------------------------------------------------------------------------------- inputs, outputs


def require_outputs_apart(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Check that no output of a command would replace what it reads, as far as its arguments and
    overrides say.

    Raises DyngsError: see ``dyngs.io.outputs.Inputs.require_output``.
    """
    words = [word.partition("=") for word in getattr(arguments, "overrides", ())]
    outputs = [
        *_values(parser, arguments, output_path),
        *(value for key, _, value in words if key == "run.dir"),
    ]
    existing = [Path(out) for out in outputs if os.path.lexists(out)]
    if not existing:
        return
    from dyngs.runs.folder import collect_inputs

    named = (value if equals else key for key, equals, value in words if key != "run.dir")
    read = [
        *_values(parser, arguments, input_path),
        *_values(parser, arguments, input_word),
        *named,
    ]
    inputs = collect_inputs(*(Path(one) for one in read if os.path.lexists(one)))
    for out in existing:
        inputs.require_output(out)


def _values(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, kind: object
) -> Iterator[str | Path]:
    """Yield the values of the arguments of a type."""
    for action in parser._actions:
        value = getattr(arguments, action.dest, None)
        if action.type is kind and value is not None:
            yield from value if isinstance(value, list) else (value,)


def computing_device(choice: str) -> torch.device:
    """Return the device that ``--device`` or ``run.device`` means; where that may surprise, a line
    on stderr says why.

    Raises DyngsError: ``cuda`` where no GPU can be used.
    """
    from dyngs.ops.device import cpu_fallback_reason, select_device

    device = select_device(choice)
    reason = cpu_fallback_reason(choice)
    if reason is not None:
        print(f"dyngs: {reason}", file=sys.stderr)
    return device


def add_max_gaussians_drawn(parser: argparse.ArgumentParser, about: str) -> None:
    kind = integer_type("a number of Gaussians", 1, 10**9 - 1)
    parser.add_argument("--max-gaussians-drawn", type=kind, metavar="N", help=about)


def is_avatar_file(path: Path) -> bool:
    """Whether a path is an avatar file, as opposed to a run folder or a .ply."""
    return path.is_file() and path.suffix.lower() == ".safetensors"


def run_of_scene_file(path: Path) -> Path:
    """Return the run folder of a ``scene.dyngs``, and any other path as it is.

    A run with checkpoints is drawn from those, which a note says.

    Raises:
        DyngsError: the file has another name.
    """
    if path.suffix.lower() != ".dyngs" or not path.is_file():
        return path
    from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths

    if path.name != SCENE_FILE:
        raise DyngsError(
            f"{path}: must be called {SCENE_FILE}, with the config.yaml of its run beside it"
        )
    if checkpoint_paths(path.parent):
        print_notes((f"{path.parent} has checkpoints: the newest one is drawn, not {SCENE_FILE}",))
    return path.parent
