"""``dyngs completion``: what the Tab key of a shell offers: commands, presets, keys and their values, runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from dyngs.cli.arguments import input_path, input_word, output_path
from dyngs.cli.docs import docs_folder

_ON_A_RUN = ("eval", "render", "view", "export")
"""Commands that take where the capture of a run lies by now, and no other setting."""
_BASH = """\
# Put this line into ~/.bashrc:   eval "$(dyngs completion bash)"
_dyngs() {
    local line="${COMP_LINE:0:COMP_POINT}" prefix="" word found
    word="${line##* }"
    if [[ $word == *=* && $COMP_WORDBREAKS == *=* ]]; then prefix="${word%"${word##*=}"}"; fi
    COMPREPLY=()
    while IFS= read -r found; do
        found="${found#"$prefix"}"
        case $found in *=|*/|*.) ;; *) found="$found " ;; esac
        COMPREPLY+=("$found")
    done < <("${COMP_WORDS[0]}" completion --line "$line" 2>/dev/null)
}
complete -o nospace -F _dyngs dyngs
"""
_ZSH = """\
# Put this line into ~/.zshrc, after compinit:   eval "$(dyngs completion zsh)"
_dyngs() {
    local -a found
    found=("${(@f)$("${words[1]}" completion --line "${(j: :)words[1,CURRENT]}" 2>/dev/null)}")
    compadd -Q -S '' -- ${(M)found:#*[=/.]}
    compadd -Q -- ${found:#*[=/.]}
}
compdef _dyngs dyngs
"""
_FISH = """\
# Put this line into ~/.config/fish/config.fish:   dyngs completion fish | source
complete -c dyngs -f -a '(dyngs completion --line (commandline -cp | string collect) 2>/dev/null)'
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}
MOST_PATHS = 500
"""Most entries of a folder that are offered."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``completion`` to the commands."""
    parser = commands.add_parser(
        "completion",
        help="completion by the Tab key, for bash, zsh and fish",
        description="Print a script for a shell, whose first line says where it goes. The Tab key then completes "
        "commands, options, presets, configuration keys with their values, runs and files.",
    )
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("shell", nargs="?", choices=tuple(SCRIPTS), help="whose script to print")
    chosen.add_argument("--line", metavar="TEXT", help="print what may stand in place of the last word of TEXT")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print a script, or the completions of a line."""
    if arguments.line is None:
        print(SCRIPTS[arguments.shell], end="")
        return 0
    from dyngs.cli import make_parser

    for found in completions(arguments.line, make_parser()):
        print(found)
    return 0


def completions(line: str, parser: argparse.ArgumentParser) -> list[str]:
    """Return what may stand in place of the last word of ``line``, which begins with the name of the program."""
    words = line.split()
    word = "" if not words or line[-1:].isspace() else words[-1]
    before = words[1:] if not word else words[1:-1]
    place = _Place(parser)
    for passed in before:
        place.go_on(passed)
    return sorted({found for found in place.offers(word) if found.startswith(word)})


class _Place:
    """How far a line has been read.

    Attributes:
        parser: of the command.
        passed: positional arguments of it so far.
        option: whose value comes next.
    """

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser, self.passed = parser, list[str]()
        self.option: argparse.Action | None = None
        self.resumes = False

    def go_on(self, word: str) -> None:
        """Read another word."""
        if self.option is not None:
            self.option = None
        elif word.startswith("-"):
            self.option = _with_value(self.parser, word)
            self.resumes |= word == "--resume"
        elif word in _commands(self.parser):
            self.parser, self.passed = _commands(self.parser)[word], []
        else:
            self.passed.append(word)

    def offers(self, word: str) -> Iterator[str]:
        """Yield what may stand here; ``word`` is what is there of it."""
        if self.option is not None:
            yield from _values(self.option, word)
        elif word.startswith("-"):
            name, equals, _ = word.partition("=")
            option = _with_value(self.parser, name) if equals else None
            if option is not None:
                yield from (f"{name}={value}" for value in option.choices or ())
            else:
                yield from (text for action in self.parser._actions for text in action.option_strings)
        elif _commands(self.parser):
            yield from _commands(self.parser)
        else:
            yield from self._positional(word)

    def _positional(self, word: str) -> Iterator[str]:
        actions = [action for action in self.parser._actions if not action.option_strings]
        places = [action for action in actions if action.dest != "overrides"]
        if len(self.passed) < len(places):
            yield from _values(places[len(self.passed)], word)
        if len(places) < len(actions):
            if not self.passed and not self.resumes and "=" not in word and not places:
                yield from (*_presets(), *_paths(word, (".yaml", ".yml")))
            if self.parser.prog.split()[-1] in _ON_A_RUN and not word.startswith("data."):
                return
            yield from _settings(word, resumes=self.resumes)


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if action.nargs == argparse.PARSER and action.choices is not None:
            found |= dict(action.choices)  # type: ignore[call-overload]
    return found


def _with_value(parser: argparse.ArgumentParser, word: str) -> argparse.Action | None:
    """Return the option ``word`` of a command if a value follows it."""
    return next((a for a in parser._actions if word in a.option_strings and a.nargs != 0), None)


def _values(action: argparse.Action, word: str) -> Iterator[str]:
    """Yield values of an argument: its choices; runs, where it is one; otherwise files."""
    metavar = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if action.choices is not None:
        yield from map(str, action.choices)
        return
    if metavar == "TOPIC":
        yield from (path.stem for path in docs_folder().glob("*.md"))
        return
    runs = [f"runs/{path.parent.name}" for path in Path("runs").glob("*/config.yaml")] if "RUN" in metavar else []
    yield from runs
    if "CONFIG" in metavar:
        yield from _presets()
    if action.type in (None, input_path, input_word, output_path):
        only_folders = metavar in ("RUN", "NET_RUN")
        found = (path for path in _paths(word) if path.endswith("/") or not only_folders)
        yield from (path for path in found if path.removesuffix("/") not in runs)


def _presets() -> list[str]:
    from dyngs.config.io import packaged_presets

    return list(packaged_presets())


def _settings(word: str, *, resumes: bool) -> Iterator[str]:
    """Yield configuration keys, section by section, or the values of the key that ``word`` begins with."""
    from dyngs.cli.train import WITH_RESUME
    from dyngs.config.schema import config_keys

    key, equals, text = word.partition("=")
    keys = [k for k in config_keys() if not resumes or k.name in WITH_RESUME]
    if equals:
        for found in (k for k in keys if k.name == key):
            yield from (f"{key}={value}" for value in _allowed(found.allowed, found.default, text))
    elif "." in word or resumes:
        yield from (f"{k.name}=" for k in keys)
    else:
        yield from (f"{k.name.split('.')[0]}." for k in keys)


def _allowed(words: str, default: str, text: str) -> Iterator[str]:
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
    elif default:
        yield default


def _paths(word: str, suffixes: Sequence[str] = ()) -> Iterator[str]:
    """Yield files, of some suffixes, and folders that begin with ``word``."""
    above, begun = os.path.split(word)
    try:
        with os.scandir(os.path.expanduser(above) or ".") as entries:
            for count, entry in enumerate(entries):
                if count >= MOST_PATHS:
                    break
                if entry.name.startswith(begun) and (begun or not entry.name.startswith(".")):
                    found = os.path.join(above, entry.name)
                    if entry.is_dir():
                        yield f"{found}/"
                    elif not suffixes or entry.name.endswith(tuple(suffixes)):
                        yield found
    except OSError:
        return
