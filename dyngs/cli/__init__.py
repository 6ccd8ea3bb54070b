"""The `dyngs` command: one module per subcommand, progress, tables, the demo.

Every module offers ``add_parser(commands)``, which adds its command, and a ``run(arguments) ->
int``. What is heavy (torch, the native core, readers) is imported inside ``run``, so that ``dyngs
--help`` is instant.

Exit codes: 0 done; 2 bad input or usage, after one line on stderr; 130 interrupted. Anything
unexpected keeps its traceback, because it is a bug. With ``--debug`` the traceback of any error
comes before its line, with ``--quiet`` results and errors alone are printed.
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
    errno.ENOSPC: "; free some space and run the command again, earlier results are untouched",
    errno.EDQUOT: "; your quota is used up, free some space and run the command again",
    errno.EPIPE: "; the program that read our output has gone",
    errno.EACCES: "; choose another folder or change its permissions",
    errno.EROFS: "; choose a folder that can be written",
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
    "docs": docs.add_parser,
    "doctor": doctor.add_parser,
}
"""What adds each command, in the order in which they are listed."""
_OVERRIDE = re.compile(r"[a-z]\w*(\.\w+)+=.*", re.DOTALL)


_NEXT = f"""\
dyngs {__version__}: Gaussian splatting of what stands, what moves, and people, on the CPU.

  dyngs demo                            a small moving scene from start to end, in minutes
  dyngs train static data.root=PHOTOS   a scene from a folder of photos, or a video
  dyngs train dynamic data.root=CAPTURE one that moves
  dyngs train human data.root=VIDEO     a person
  dyngs view runs/NAME                  look at it
  dyngs render runs/NAME --out images   images and videos; `dyngs export` writes files for others

`dyngs --help` lists all commands, `dyngs docs` is the manual, `dyngs doctor` checks what is here.\
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: ``sys.argv``) and return the exit code."""
    if "_ARGCOMPLETE" in os.environ:  # a shell asks, at the Tab key
        from argcomplete import autocomplete

        autocomplete(make_parser(), always_complete_options=False)
    words, flags = _without_flags(list(sys.argv[1:] if argv is None else argv))
    print_messages(quiet="--quiet" in flags)
    _show_any_name()
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
        with suppress(OSError):  # stderr may lie on a full disk
            print(f"dyngs: error: {format_one_line(message)}", file=sys.stderr)
        _abandon_if_broken(sys.stderr)
        return EXIT_ERROR


def _message_of(error: Exception) -> str | None:
    """Return the line for the user; None of an error that is a bug."""
    if isinstance(error, DyngsError):
        return str(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror or error}{_ADVICE.get(error.errno or 0, '')}"
    if "CUDA out of memory" in str(error):
        return "the GPU is out of memory; lower strategy.max_gaussians or data.longest_side, or give --device cpu"
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return "out of memory; use smaller images (data.longest_side) or a smaller cache (data.cache_mb)"
    return None


def _without_flags(arguments: list[str]) -> tuple[list[str], set[str]]:
    """Return the arguments without ``--debug`` and ``--quiet``, which may stand anywhere before
    ``--``, and those of the two that were given."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    flags = {"--debug", "--quiet"} & set(arguments[:end])
    return [word for word in arguments[:end] if word not in flags] + arguments[end:], flags


def _show_any_name() -> None:
    """Print file names that are not valid text with escapes on stdout, as stderr does; a closed one
    takes nothing."""
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
        raise DyngsError(f"{error}; if it was moved: `{again}`") from error


def _parsed(parser: argparse.ArgumentParser, arguments: list[str]) -> argparse.Namespace:
    """Parse arguments; overrides may stand anywhere, also after options, where argparse allows
    none."""
    parsed, rest = parser.parse_known_args(arguments)
    overrides = getattr(parsed, "overrides", None)
    unknown = [word for word in rest if overrides is None or not _OVERRIDE.fullmatch(word)]
    if unknown:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    if overrides is not None:
        overrides += rest
    return parsed


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line; what it returns also holds the ``parser`` of the command
    itself."""

    def parse_known_args(
        self, args: Any = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        parsed, rest = super().parse_known_args(args, namespace)
        if "parser" not in parsed:
            parsed.parser = self
        return parsed, rest

    def error(self, message: str) -> NoReturn:
        raise DyngsError(f"{format_one_line(message, 400)} (see `{self.prog} --help`)")


def make_parser(only: str = "") -> argparse.ArgumentParser:
    """Return the parser of all commands, or, in a fraction of the time, of the command ``only``
    where there is one."""
    parser = _Parser(
        prog="dyngs", description="Gaussian splatting that runs where people are: on the CPU."
    )
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    about = "print results and errors alone, no notes and warnings"
    parser.add_argument("--quiet", action="store_true", help=about)
    parser.add_argument("--version", action="version", version=f"dyngs {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for add_parser in [_COMMANDS[only]] if only in _COMMANDS else _COMMANDS.values():
        add_parser(commands)
    return parser


def _abandon_if_broken(stream: TextIO) -> None:
    """Redirect a broken stream to the null device, because the interpreter would fail to flush it
    at exit."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
