"""``dyngs docs``: the documentation that comes with dyngs."""

from __future__ import annotations

import argparse
import inspect
import os
import re
import sys
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path

from dyngs.cli.arguments import Commands, add_command
from dyngs.core.errors import DyngsError

_EPILOG = """\
examples:
  dyngs docs                       list all pages
  dyngs docs photos
  dyngs docs concepts/people       where two pages have the same name
  dyngs docs --search opacity      lines of all pages with this text
"""


def add_parser(commands: Commands) -> None:
    about = "Show a page of the documentation, or list all pages. Without a terminal: as Markdown."
    parser = add_command(commands, "docs", run, "show the documentation", about, _EPILOG)
    parser.add_argument(
        "page", nargs="?", metavar="PAGE", help="name of a page, for instance cli or photos"
    )
    parser.add_argument("--search", metavar="TEXT", help="print the lines of all pages with TEXT")
    parser.add_argument(
        "--path", action="store_true", help="print the path of the page or the folder of all pages"
    )


def run(arguments: argparse.Namespace) -> int:
    folder = docs_folder()
    if arguments.path:
        print(folder if arguments.page is None else page_path(folder, arguments.page))
    elif arguments.search is not None:
        print(*search(folder, arguments.search), sep="\n")
    elif arguments.page is None:
        print_list(folder)
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


def find_pages(folder: Path) -> dict[str, Path]:
    """Return all pages by name, for instance ``guides/photos``, and by the short name ``photos``.

    A page of the guides comes first where several have the same short name.
    """
    full = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for path in sorted(folder.rglob("*.md"))
    }
    short: dict[str, Path] = {}
    for name, path in sorted(full.items(), key=lambda item: not item[0].startswith("guides/")):
        short.setdefault(name.rpartition("/")[2], path)
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


def print_list(folder: Path) -> None:
    """Print the name and the title of each page, by folder."""
    section = None
    for path in sorted(folder.rglob("*.md"), key=lambda path: (path.parent, path.name)):
        name = path.relative_to(folder).with_suffix("")
        if name.parent.as_posix() != section:
            section = name.parent.as_posix()
            print(f"\n{section}" if section != "." else "pages; `dyngs docs NAME` shows one")
        print(f"  {name.name:<22}{title_of(path.read_text(encoding='utf-8'))}")


def title_of(text: str) -> str:
    match = re.search(r"^# (.+)$", text, re.MULTILINE)
    return match[1] if match else ""


def search(folder: Path, text: str) -> Iterator[str]:
    """Yield the lines with a text, in any case. Raises DyngsError: no page has it."""
    found = False
    for path in sorted(folder.rglob("*.md")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if text.lower() in line.lower():
                found = True
                yield f"{name}:{number}: {line.strip()}"
    if not found:
        raise DyngsError(f"no page contains {text!r}")


def page_text(path: Path) -> str:
    """Return the Markdown of a page, with the API documentation that the site inserts."""
    text = path.read_text(encoding="utf-8")
    return re.sub(
        r"^::: (dyngs[.\w]*)\n(?:[ \t]+.*\n)*", _describe_object, text, flags=re.MULTILINE
    )


def _describe_object(match: re.Match[str]) -> str:
    """Return the signature and the docstring of a public object as Markdown."""
    import pydoc

    name = match[1]
    value = pydoc.locate(name)
    parts = [f"### {name}\n"]
    if callable(value):
        parts.append(f"```python\n{_signature(name, value)}\n```\n")
    parts.append(f"{inspect.getdoc(value)}\n")
    if inspect.isclass(value):
        for key, member in vars(value).items():
            if not key.startswith("_") and inspect.isfunction(member) and member.__doc__:
                parts.append(f"```python\n{_signature(f'{name}.{key}', member)}\n```\n")
                parts.append(f"{inspect.getdoc(member)}\n")
    return "\n".join(parts)


def _signature(name: str, value: object) -> str:
    try:
        return f"{name}{inspect.signature(value)}"  # pyright: ignore[reportArgumentType]
    except ValueError:
        return name


def show(text: str) -> None:
    """Show Markdown in the pager of the terminal; print it as it is without a terminal."""
    if not sys.stdout.isatty():
        print(text, end="")
        return
    from rich.console import Console
    from rich.markdown import Markdown

    os.environ.setdefault("LESS", "-R")  # less shows escape codes of colours as text otherwise
    console = Console()
    with console.pager(styles=True):
        console.print(Markdown(text))
