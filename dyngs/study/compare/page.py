"""The page of a comparison: one file with table, curves and synchronised crops, which asks no host
for anything."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from dyngs.export.html.template import filled, script_safe, source_hash
from dyngs.study.compare.plan import Bench
from dyngs.study.compare.result import TRUTH, Result
from dyngs.study.tables import html_table

HERE = Path(__file__).parent


def page_text(
    bench: Bench,
    results: Sequence[Result],
    left_out: Mapping[str, str],
    parts: tuple[str, list[str], list[list[str]], str],
) -> str:
    """Return the page; ``parts``: what all had the same of, head and cells of the table, and the
    plot as SVG or ""."""
    about, head, cells, svg = parts
    style, script = (_file(f"page.{suffix}") for suffix in ("css", "js"))
    plot = (
        ""
        if not svg
        else f'<img class="plot" alt="PSNR over seconds of training" src="{_data("svg+xml", svg)}">'
    )
    missing = "".join(
        f"<p>Left out: <b>{escape(n)}</b>: {escape(why)}</p>" for n, why in left_out.items()
    )
    pieces = {
        "style": style,
        "style_hash": source_hash(style),
        "script": script,
        "script_hash": source_hash(script),
    }
    pieces |= {"about": escape(about), "plot": plot, "left_out": missing}
    pieces |= {"table": html_table(head, cells), "views": script_safe(_views(bench, results))}
    return filled(_file("page.html"), pieces)


def _views(bench: Bench, results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return the views that are shown, each with its images: the truth first, then those of the
    models."""
    return [
        {
            "name": name,
            "truth": _image(bench.image_path(TRUTH, index)),
            "models": [
                {
                    "name": result.name,
                    "psnr": result.views[index][1],
                    "image": _image(bench.image_path(result.name, index)),
                }
                for result in results
            ],
        }
        for index, (name, _) in enumerate(results[0].views)
    ]


def _image(path: Path) -> str:
    return _data("png", path.read_bytes())


def _data(kind: str, content: str | bytes) -> str:
    raw = content.encode() if isinstance(content, str) else content
    return f"data:image/{kind};base64,{base64.b64encode(raw).decode()}"


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")
