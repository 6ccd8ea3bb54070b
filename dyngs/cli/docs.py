"""``dyngs docs``: the documentation that comes with dyngs."""

from __future__ import annotations

import argparse
import os
import sys
from difflib import get_close_matches
from pathlib import Path

from dyngs.cli.arguments import Commands, add_command
from dyngs.core.errors import DyngsError

_FRONT = "README"


def add_parser(commands: Commands) -> None:
    about = "Show a page of the documentation (without a terminal: as Markdown), or the list of all pages."
    parser = add_command(commands, "docs", run, "the documentation", about)
    parser.add_argument(
        "topic", nargs="?", metavar="TOPIC", help="name of a page, for instance cli or photos"
    )
    parser.add_argument(
        "--path", action="store_true", help="print only where the page, or the folder, lies"
    )


def run(arguments: argparse.Namespace) -> int:
    folder = docs_folder()
    if arguments.path:
        print(folder if arguments.topic is None else page(folder, arguments.topic))
        return 0
    path = page(folder, _FRONT if arguments.topic is None else arguments.topic)
    text = path.read_text(encoding="utf-8")
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.markdown import Markdown

        os.environ.setdefault("LESS", "-R")  # otherwise less shows colours as codes
        console = Console()
        with console.pager(styles=True):
            console.print(Markdown(text))
    else:
        print(text, end="")
    return 0


def docs_folder() -> Path:
    """Return the folder of the pages: in an installation that of the package, in a checkout that of
    the repository.

    Raises DyngsError: it is not there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "docs", package.parent / "docs"):
        if (folder / f"{_FRONT}.md").is_file():
            return folder
    raise DyngsError("the documentation is not installed; install dyngs again")


def page(folder: Path, topic: str) -> Path:
    """Return the page of a topic. Raises DyngsError: there is none; names those that are
    similar."""
    pages = {path.stem: path for path in sorted(folder.glob("*.md"))}
    name = topic.removesuffix(".md")
    if name in pages:
        return pages[name]
    close = get_close_matches(name.lower(), pages, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise DyngsError(
        f"no page {topic!r}{hint}; there are {', '.join(key for key in pages if key != _FRONT)}"
    )
