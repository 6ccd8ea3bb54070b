"""Command-line arguments and argument types shared by several commands."""

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
    """Add a subcommand executed by ``run``; return its parser."""
    formatter = argparse.HelpFormatter if epilog is None else argparse.RawDescriptionHelpFormatter
    parser = commands.add_parser(
        name, help=help, description=description, epilog=epilog, formatter_class=formatter
    )
    parser.set_defaults(run=run)
    return parser


# -------------------------------------------------------------------------------------------- types


def input_path(text: str) -> Path:
    """Argument type of an input path."""
    return Path(text)


def input_word(text: str) -> str:
    """Argument type of an input path or a name, such as a preset."""
    return text


def output_path(text: str) -> Path:
    """Argument type of an output path."""
    return Path(text)


def integer_type(what: str, low: int, high: int, more: str = "") -> Callable[[str], int]:
    """Return the argument type of an integer in [``low``, ``high``].

    ``what`` names it in messages, with an article.
    """

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdigit() and len(text) < 10 and low <= int(text) <= high):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {what}; write a whole number from {low} to {high:,}{more}"
            )
        return int(text)

    return parse


def scene_time(text: str) -> float:
    """Parse a finite time; values outside [0, 1] are clamped later, with a warning."""
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
    """Parse ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    if not match or "0" in match.groups():
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size; write WIDTHxHEIGHT, for instance 1280x720"
        )
    return int(match[1]), int(match[2])


# ---------------------------------------------------------------------------------------- arguments


def add_threads(parser: argparse.ArgumentParser) -> None:
    kind = integer_type("a number of threads", 0, 1024, ", 0 for all cores")
    parser.add_argument(
        "--threads", type=kind, default=0, metavar="N", help="number of threads, 0 = all cores"
    )


def add_device(parser: argparse.ArgumentParser, default: str = "auto") -> None:
    about = f"device; auto: a supported CUDA GPU if there is one, else the CPU (default {default})"
    parser.add_argument("--device", choices=_DEVICES, default=default, help=about)


def add_run_device(parser: argparse.ArgumentParser) -> None:
    """Add ``--device`` to a command that trains: it sets ``run.device``."""
    parser.add_argument(
        "--device",
        choices=_DEVICES,
        help="device to train on, same as run.device=... (default auto)",
    )


def run_device(arguments: argparse.Namespace) -> list[str]:
    """Return ``--device`` of ``add_run_device`` as an override."""
    return [] if arguments.device is None else [f"run.device={arguments.device}"]


def add_json(parser: argparse.ArgumentParser) -> None:
    about = "print the result as JSON on stdout and everything else on stderr"
    parser.add_argument("--json", action="store_true", help=about)


def add_split(
    parser: argparse._ActionsContainer, about: str = "default test", default: str | None = "test"
) -> None:
    parser.add_argument(
        "--split", choices=("test", "val", "train", "pose"), default=default, help=about
    )


def add_up(parser: argparse.ArgumentParser, of: str = "") -> None:
    """Add ``--up``, the up axis of the scene."""
    usual = "default: from the cameras of a run, or from the file or its format"
    parser.add_argument("--up", choices=AXES, help=f"up axis{of} ({usual})")


def add_motion(parser: argparse._ActionsContainer) -> None:
    about = "motion file for a person: .npz (AMASS, SMPL-X), .bvh, .glb, .gltf, .vrma"
    parser.add_argument("--motion", type=input_path, metavar="FILE", help=about)


def play_motion(arguments: argparse.Namespace, opened: OpenedScene) -> OpenedScene:
    """Apply ``--motion`` to the person, if given, and print the notes about it."""
    if arguments.motion is None:
        return opened
    moved = opened.play_motion(arguments.motion)
    print_notes(moved.notes[len(opened.notes) :])
    return replace(moved, notes=opened.notes)


def add_overrides(parser: argparse.ArgumentParser, metavar: str, about: str) -> None:
    parser.add_argument("overrides", nargs="*", default=[], metavar=metavar, help=about)


def add_data_root(parser: argparse.ArgumentParser) -> None:
    """Add the overrides of a command that reads the capture of a run."""
    about = "current folder of the capture, if it was moved; data.follow_links=true allows links out of it"
    add_overrides(parser, "data.root=FOLDER", about)
    parser.set_defaults(takes_root=True)


def data_root(arguments: argparse.Namespace) -> Path | None:
    """Return the folder given as ``data.root``; None if not given.

    Raises DyngsError: any other override.
    """
    found = None
    for word in arguments.overrides:
        key, equals, value = word.partition("=")
        if word in ("data.follow_links=true", "data.follow_links=false"):
            continue
        if key.strip() != "data.root" or not equals or not value.strip():
            raise DyngsError(
                f"{word!r}: the configuration of a run is fixed; only data.root=FOLDER (a moved "
                "capture) and data.follow_links=true are accepted"
            )
        found = Path(value.strip())
    return found


def follows_links(overrides: Sequence[str]) -> bool:
    """Return whether overrides set ``data.follow_links=true``."""
    from dyngs.config.yaml_reader import read_override

    leaves = [
        leaf
        for word in overrides
        if word.startswith("data") and "=" in word
        for leaf in read_override(word)
    ]
    return any(leaf.keys == ("data", "follow_links") and leaf.value == "true" for leaf in leaves)


def data_section(overrides: list[str]) -> DataConfig:
    """Build the data section from ``data.key=value`` overrides; its root is a placeholder."""
    from dyngs.config.io import load_config

    for word in overrides:
        if not word.startswith("data.") or word.startswith("data.root="):
            raise DyngsError(
                f"{word!r}: only keys of data are accepted, such as data.follow_links=true"
            )
    return load_config(None, ["data.root=.", *overrides]).data


# ---------------------------------------------------------------------------------- inputs, outputs


def require_outputs_apart(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Check that no output path in the arguments or overrides would replace an input.

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
    """Yield the values of all arguments of a type."""
    for action in parser._actions:
        value = getattr(arguments, action.dest, None)
        if action.type is kind and value is not None:
            yield from value if isinstance(value, list) else (value,)


def computing_device(choice: str) -> torch.device:
    """Resolve ``--device`` or ``run.device``; print the reason if an available GPU is not used.

    Raises DyngsError: ``cuda`` without a supported GPU.
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
    """Return whether a path is an avatar file."""
    return path.is_file() and path.suffix.lower() == ".safetensors"


def run_of_scene_file(path: Path) -> Path:
    """Return the run folder of a ``scene.dyngs``, and any other path unchanged.

    If the folder has checkpoints, these are used instead of the file and a note is printed.

    Raises DyngsError: a .dyngs file with another name.
    """
    if path.suffix.lower() != ".dyngs" or not path.is_file():
        return path
    from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths

    if path.name != SCENE_FILE:
        raise DyngsError(
            f"{path}: must be named {SCENE_FILE} and be in a folder with its config.yaml"
        )
    if checkpoint_paths(path.parent):
        print_notes((f"using the newest checkpoint of {path.parent} instead of {SCENE_FILE}",))
    return path.parent
