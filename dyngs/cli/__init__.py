"""The ``dyngs`` command: one module per subcommand, progress bars, tables and the demo.

Each module has ``add_parser(commands)``, which adds its subcommand, and ``run(arguments) -> int``.
Heavy modules (torch, the native core, readers) are imported inside ``run`` to keep ``dyngs --help``
fast.

Exit codes: 0 success; 2 bad input or usage, with one line on stderr; 130 interrupted. Unexpected
exceptions keep their traceback, because they are bugs. ``--debug`` prints the traceback of every
error, ``--quiet`` suppresses notes and warnings.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import Any, NoReturn, TextIO

from dyngs import __version__
from dyngs.cli import (
    config,
    convert,
    data,
    demo,
    docs,
    doctor,
    edit,
    evaluate,
    export,
    predict,
    prune,
    render,
    study,
    train,
    view,
)
from dyngs.cli.arguments import follows_links, require_outputs_apart
from dyngs.cli.output import print_messages
from dyngs.core.errors import (
    DyngsError,
    NoCaptureError,
    format_one_line,
    quote_word,
    validate_file_name,
)
from dyngs.io.containment import allow_run_links

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
_ADVICE = {
    errno.ENOSPC: "; free disk space and run the command again, earlier results are kept",
    errno.EDQUOT: "; your disk quota is used up, free space and run the command again",
    errno.EPIPE: "; the program that reads the output has ended",
    errno.EACCES: "; choose another folder or change its permissions",
    errno.EROFS: "; choose a writable folder",
}
_COMMANDS: dict[str, Callable[[Any], None]] = {
    "demo": demo.add_parser,
    "train": train.add_parser,
    "prune": prune.add_parser,
    "predict": predict.add_parser,
    "eval": evaluate.add_parser,
    "render": render.add_parser,
    "view": view.add_parser,
    "export": export.add_parser,
    "convert": convert.add_parser,
    "edit": edit.add_parser,
    "tradeoff": study.add_tradeoff_parser,
    "compare": study.add_parser,
    "data": data.add_parser,
    "config": config.add_parser,
    "presets": config.add_presets_parser,
    "docs": docs.add_parser,
    "doctor": doctor.add_parser,
}
"""Functions that add the subcommands, in the order of ``dyngs --help``."""
_OVERRIDE = re.compile(r"[a-z]\w*(\.\w+)+=.*", re.DOTALL)


_NEXT = f"""\
dyngs {__version__}: Gaussian splatting for static scenes, moving scenes and people, on the CPU.

  dyngs demo                             train and render a small moving scene in minutes
  dyngs train PHOTOS                     train a scene from a folder of photos
  dyngs train VIDEO                      train a moving scene from a video
  dyngs train human VIDEO                train an avatar of a person
  dyngs view runs/NAME                   view a run in a browser
  dyngs render runs/NAME --out images    render images and videos
  dyngs export runs/NAME                 write .ply and other formats

`dyngs --help` lists all commands, `dyngs docs` the manual; `dyngs doctor` checks the installation.\
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: ``sys.argv``) and return the exit code."""
    if "_ARGCOMPLETE" in os.environ:  # tab completion of a shell
        from argcomplete import autocomplete

        autocomplete(make_parser(), always_complete_options=False)
    words, flags = _without_flags(list(sys.argv[1:] if argv is None else argv))
    print_messages(quiet="--quiet" in flags)
    _escape_invalid_names()
    try:
        code = _dispatch(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt as interrupt:
        with suppress(OSError):  # the terminal may be closed
            print(
                f"\ndyngs: interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr
            )
        _abandon_if_broken(sys.stdout)
        _abandon_if_broken(sys.stderr)
        return EXIT_INTERRUPTED
    except (DyngsError, MemoryError, RuntimeError, OSError) as error:
        message = _message_of(error)
        if message is None:
            raise
        _abandon_if_broken(sys.stdout)
        if "--debug" in flags:
            traceback.print_exception(error)
        with suppress(OSError):  # stderr may be a file on a full disk
            print(f"dyngs: error: {format_one_line(message)}", file=sys.stderr)
        _abandon_if_broken(sys.stderr)
        return EXIT_ERROR


def _message_of(error: Exception) -> str | None:
    """Return the message for the user; None for an unexpected error."""
    if isinstance(error, DyngsError):
        return str(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}{_ADVICE.get(error.errno or 0, '')}"
    if "CUDA out of memory" in str(error):
        return (
            "GPU out of memory; lower strategy.max_gaussians or data.longest_side, "
            "or use --device cpu"
        )
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return (
            "out of memory; lower the image size (data.longest_side) or the cache (data.cache_mb)"
        )
    return None


def _without_flags(arguments: list[str]) -> tuple[list[str], set[str]]:
    """Split off ``--debug`` and ``--quiet``, which are accepted anywhere before ``--``."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    flags = {"--debug", "--quiet"} & set(arguments[:end])
    return [word for word in arguments[:end] if word not in flags] + arguments[end:], flags


def _escape_invalid_names() -> None:
    """Escape file names that are not valid text on stdout; replace closed streams by the null
    device."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # as after >&-
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - for the life of the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _dispatch(arguments: list[str]) -> int:
    for word in arguments:
        validate_file_name(word)
    if not arguments:
        print(_NEXT)
        return 0
    parser = make_parser(arguments[0])
    try:
        parsed = _parsed(parser, arguments)
    except SystemExit as stop:  # after --help or --version
        return int(stop.code or 0)
    if "run" not in parsed:
        parser.print_help()
        return 0
    try:
        with allow_run_links(follows_links(getattr(parsed, "overrides", ()))):
            require_outputs_apart(parsed.parser, parsed)
            return parsed.run(parsed)
    except NoCaptureError as error:
        names_root = any(
            word.strip().startswith("data.root") for word in getattr(parsed, "overrides", ())
        )
        if not getattr(parsed, "takes_root", False) or names_root:
            raise
        again = " ".join(map(quote_word, ["dyngs", *arguments, "data.root=FOLDER"]))
        raise DyngsError(f"{error}; if the capture was moved, run `{again}`") from error


def _parsed(parser: argparse.ArgumentParser, arguments: list[str]) -> argparse.Namespace:
    """Parse arguments, with overrides also after options, which argparse does not support."""
    parsed, rest = parser.parse_known_args(arguments)
    overrides = getattr(parsed, "overrides", None)
    unknown = [word for word in rest if overrides is None or not _OVERRIDE.fullmatch(word)]
    if unknown and arguments[0] == "train":
        parsed.parser.error(train.describe_option(unknown[0]))
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if overrides is not None:
        overrides += rest
    return parsed


class _Parser(argparse.ArgumentParser):
    """Argument parser with one-line errors that adds itself to the namespace as ``parser``."""

    def parse_known_args(
        self, args: Any = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        parsed, rest = super().parse_known_args(args, namespace)
        if "parser" not in parsed:
            parsed.parser = self
        return parsed, rest

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse an unknown command with the commands, also those of ``data``, of similar names."""
        choices = action.choices or ()
        if isinstance(action, argparse._SubParsersAction) and value not in choices:
            known = {name: f"{self.prog} {name}" for name in choices}
            if "data" in choices:
                known |= {name: f"dyngs data {name}" for name in data.VERBS}
            close = [f"`{known[name]}`" for name in get_close_matches(value, known, cutoff=0.7)]
            if os.path.exists(value):
                close = [f"`dyngs train {quote_word(value)}`"]
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise DyngsError(f"unknown command {value!r}{hint} (see `{self.prog} --help`)")
        super()._check_value(action, value)

    def error(self, message: str) -> NoReturn:
        raise DyngsError(f"{format_one_line(message, 400)} (see `{self.prog} --help`)")


def make_parser(only: str = "") -> argparse.ArgumentParser:
    """Build the parser of all commands, or faster, only of the command ``only`` if it exists."""
    parser = _Parser(
        prog="dyngs",
        description="Gaussian splatting for static scenes, moving scenes and people, on the CPU.",
    )
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    about = "print results and errors only, no notes and warnings"
    parser.add_argument("--quiet", action="store_true", help=about)
    parser.add_argument("--version", action="version", version=f"dyngs {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for add_parser in [_COMMANDS[only]] if only in _COMMANDS else _COMMANDS.values():
        add_parser(commands)
    return parser


def _abandon_if_broken(stream: TextIO) -> None:
    """Redirect a broken stream to the null device, so that flushing it at exit does not fail."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
