"""The files of a report, and its plot as SVG and PNG, drawn by matplotlib, of the extra
``plots``."""

from __future__ import annotations

import io
from collections.abc import Mapping
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.io.write import atomic_file, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MISSING = "the plot needs the package matplotlib; run pip install 'dyngs[plots]'"


def can_plot() -> bool:
    return find_spec("matplotlib") is not None


def svg_of(figure: Figure) -> str:
    """Return a figure as an SVG element, whose points have their labels as tooltips; equal figures
    give equal text."""
    import matplotlib

    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "dyngs", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    for tip in {
        str(line.get_gid()) for axes in figure.axes for line in axes.lines if line.get_gid()
    }:
        text = text.replace(f'<g id="{tip}">', f"<g><title>{escape(tip)}</title>")
    return text


def png_of(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=200, metadata={"Software": None})
    return file.getvalue()


def write_files(
    stem: Path, texts: Mapping[str, str], svg: str, figure: Figure | None
) -> list[Path]:
    """Write ``texts`` by their suffixes and the plot, if there is one, beside each other; return
    their paths.

    ``stem`` is the path without a suffix, ``svg`` the ``figure`` as a page has it.
    """
    texts = {**texts, "svg": svg} if figure is not None else texts
    paths = [stem.parent / f"{stem.name}.{suffix}" for suffix in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        write_text(path, text)
    if figure is None:
        return paths
    with atomic_file(stem.parent / f"{stem.name}.png") as temporary:
        temporary.write_bytes(png_of(figure))
    return [*paths, stem.parent / f"{stem.name}.png"]
