"""``dyngs docs``: the documentation that comes with dyngs."""

from __future__ import annotations

import argparse
import os
import re
import sys
from difflib import get_close_matches
from pathlib import Path
from pydoc import plain, render_doc

from dyngs.cli.arguments import Commands, add_command
from dyngs.core.errors import DyngsError

_EPILOG = """\
examples:
  dyngs docs                       list all pages
  dyngs docs photos
  dyngs docs concepts/people       where two pages have the same name
"""


def add_parser(commands: Commands) -> None:
    about = "Show a page of the documentation, or list all pages. Without a terminal: as Markdown."
    parser = add_command(commands, "docs", run, "show the documentation", about, _EPILOG)
    parser.add_argument(
        "page", nargs="?", metavar="PAGE", help="name of a page, for instance cli or photos"
    )
    parser.add_argument(
        "--path", action="store_true", help="print the path of the page or the folder of all pages"
    )


def run(arguments: argparse.Namespace) -> int:
    folder = docs_folder()
    if arguments.path:
        print(folder if arguments.page is None else page_path(folder, arguments.page))
    elif arguments.page is None:
        print("pages; `dyngs docs NAME` shows one:", *full_names(folder), sep="\n  ")
    else:
        show(page_text(page_path(folder, arguments.page)))
    return 0


def docs_folder() -> Path:
    """Return the folder of the pages: in an installation that of the package, in a checkout that of
    the repository.

    Raises DyngsError: it is not there.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "docs", package.parent / "docs"):
        if (folder / "index.md").is_file():
            return folder
    raise DyngsError("the documentation is not installed; install dyngs again")


def full_names(folder: Path) -> dict[str, Path]:
    """Return all pages by name, for instance ``guides/photos``."""
    paths = sorted(folder.rglob("*.md"))
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in paths}


def find_pages(folder: Path) -> dict[str, Path]:
    """Return all pages by name and by the short name, for instance ``photos``.

    A page of the guides comes first where several have the same short name.
    """
    full = full_names(folder)
    short: dict[str, Path] = {}
    for path in sorted(full.values(), key=lambda path: path.parent.name != "guides"):
        short.setdefault(path.stem, path)
    return {**short, **full}


def page_path(folder: Path, name: str) -> Path:
    """Return the page with a name. Raises DyngsError: no page has it; names a similar one."""
    pages = find_pages(folder)
    name = name.removesuffix(".md")
    if name in pages:
        return pages[name]
    close = get_close_matches(name.lower(), pages, n=1)
    hint = f"did you mean {close[0]!r}? " if close else ""
    raise DyngsError(f"no page {name!r}; {hint}`dyngs docs` lists all pages")


def page_text(path: Path) -> str:
    """Return the Markdown of a page, with the API documentation that the site inserts."""
    text = path.read_text(encoding="utf-8")
    return re.sub(
        r"^::: (dyngs[.\w]*)\n(?:[ \t]+.*\n)*",
        lambda match: f"```text\n{plain(render_doc(match[1]))}```\n",
        text,
        flags=re.MULTILINE,
    )


def show(text: str) -> None:
    """Show Markdown in the pager of the terminal, or print its source without a terminal."""
    if not sys.stdout.isatty():
        print(text, end="")
        return
    from rich.console import Console
    from rich.markdown import Markdown

    os.environ.setdefault("LESS", "-R")  # less shows escape codes of colours as text otherwise
    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(text))
