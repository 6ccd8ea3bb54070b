"""``dyngs completion``: what the Tab key of a shell offers, by argcomplete: commands, presets,
keys, values, runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import Commands, add_command, input_path, input_word, output_path
from dyngs.cli.docs import docs_folder

if TYPE_CHECKING:
    from argcomplete.finders import CompletionFinder

_HEADS = {
    "bash": '# Put this line into ~/.bashrc:   eval "$(dyngs completion bash)"',
    "zsh": '# Put this line into ~/.zshrc, after compinit:   eval "$(dyngs completion zsh)"',
    "fish": "# Put this line into ~/.config/fish/config.fish:   dyngs completion fish | source",
}
MOST_PATHS = 500
"""Most entries of a folder that are offered."""


def add_parser(commands: Commands) -> None:
    parser = add_command(
        commands,
        "completion",
        run,
        "completion by the Tab key, for bash, zsh and fish",
        "Print a script for a shell, whose first line says where it goes. The Tab key then completes commands, "
        "options, presets, configuration keys with their values, runs and files.",
    )
    parser.add_argument("shell", choices=tuple(_HEADS), help="whose script to print")


def run(arguments: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    print(f"{_HEADS[arguments.shell]}\n{shellcode(['dyngs'], shell=arguments.shell)}", end="")
    return 0


def finder(parser: argparse.ArgumentParser) -> CompletionFinder:
    """Return what tells a shell that asks, by environment variables, what it may offer, when called
    with ``parser``."""
    from argcomplete.finders import CompletionFinder

    _prepare(parser)
    return CompletionFinder(parser, always_complete_options=False)


def _prepare(parser: argparse.ArgumentParser) -> None:
    """Give each argument of a parser, and of its commands, what lists its values."""
    for action in parser._actions:
        if action.nargs == argparse.PARSER:
            for command in dict(action.choices or {}).values():  # type: ignore[call-overload]
                _prepare(command)
        elif action.choices is None and action.nargs != 0:
            action.completer = _overrides if action.dest == "overrides" else _values  # type: ignore[attr-defined]


def _values(action: argparse.Action, prefix: str, **_: object) -> Iterator[str]:
    """Yield values of an argument: presets or runs, where it may be one; files."""
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if metavar == "TOPIC":
        yield from (path.stem for path in docs_folder().glob("*.md"))
        return
    runs = (
        [f"runs/{path.parent.name}" for path in Path("runs").glob("*/config.yaml")]
        if "RUN" in metavar
        else []
    )
    yield from runs
    if "CONFIG" in metavar:
        yield from _presets()
    if action.type in (None, input_path, input_word, output_path):
        found = (
            path
            for path in _paths(prefix)
            if path.endswith("/") or metavar not in ("RUN", "NET_RUN")
        )
        yield from (path for path in found if path.removesuffix("/") not in runs)


def _overrides(
    action: argparse.Action, prefix: str, parsed_args: argparse.Namespace, **_: object
) -> list[str]:
    """Return presets and keys, section by section, or the values of the key that is there."""
    from dyngs.cli.train import WITH_RESUME
    from dyngs.config.schema import config_keys

    resumes = getattr(parsed_args, "resume", None) is not None
    metavar = str(action.metavar)
    key, equals, text = prefix.partition("=")
    known = [k for k in config_keys() if not resumes or k.name in WITH_RESUME]
    known = [k for k in known if "key" in metavar or k.name == "data.root"]
    if equals:
        return [
            f"{key}={value}" for k in known if k.name == key for value in _allowed(k.allowed, text)
        ]
    presets = (
        [*_presets(), *_paths(prefix, (".yaml", ".yml"))]
        if "CONFIG" in metavar and not resumes
        else []
    )
    presets = [preset for preset in presets if preset.startswith(prefix)]
    names = [f"{k.name}=" for k in known if k.name.startswith(prefix)]
    sections = {f"{name.split('.')[0]}." for name in names}
    return names if "." in prefix or (len(sections) == 1 and not presets) else [*presets, *sections]


def _presets() -> list[str]:
    from dyngs.config.io import packaged_presets

    return list(packaged_presets())


def _allowed(words: str, text: str) -> Iterator[str]:
    """Yield the values that ``words`` allow, as ``dyngs.config.schema`` puts them."""
    plain = words.removesuffix(" or null")
    if plain != words:
        yield "null"
    if plain.startswith("one of "):
        yield from plain.removeprefix("one of ").split(", ")
    elif plain == "true or false":
        yield from ("true", "false")
    elif plain == "a path":
        yield from _paths(text)


def _paths(word: str, suffixes: Sequence[str] = ()) -> Iterator[str]:
    """Yield files, of some suffixes, and folders that begin with ``word``."""
    above, begun = os.path.split(word)
    try:
        with os.scandir(os.path.expanduser(above) or ".") as entries:
            for _, entry in zip(range(MOST_PATHS), entries, strict=False):
                if entry.name.startswith(begun) and (begun or not entry.name.startswith(".")):
                    found = os.path.join(above, entry.name)
                    if entry.is_dir():
                        yield f"{found}/"
                    elif not suffixes or entry.name.endswith(tuple(suffixes)):
                        yield found
    except OSError:
        return
