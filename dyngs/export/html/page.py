"""The page of a scene: one file with everything in it, which asks no host for anything."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dyngs.camera import Cameras
from dyngs.conventions import RasterizeMode
from dyngs.export.html.lists import Lists
from dyngs.export.html.numbers import add_scene
from dyngs.files.write import write_text
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import Scene

HERE = Path(__file__).parent
SCRIPTS = ("data.js", "motion.js", "sort.js", "renderer.js", "camera.js", "player.js", "main.js")
SHADERS = ("project.glsl", "splat.vert.glsl", "splat.frag.glsl", "copy.vert.glsl", "copy.frag.glsl")
TOLERANCE = 0.25
"""Pixels of the first view that a place at its target may be off where motion is fitted."""


@dataclass(frozen=True)
class Staging:
    """How a scene is shown.

    Attributes:
        title: shown in a corner and in the title bar; any text.
        views: cameras to begin with and to go through, at least one, each a batch of one.
        target: point to look at, world units.
        up: direction, world.
        background: colour in [0, 1].
        seconds: from time 0 to time 1.
        time: to begin with.
    """

    title: str
    views: tuple[Cameras, ...]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seconds: float = 1.0
    time: float = 0.0


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk: its path, its size in bytes, and what its header says beside the layout."""

    path: Path
    num_bytes: int
    header: dict[str, Any]


def write_page(scene: Scene, options: RenderOptions, staging: Staging, path: Path) -> WrittenPage:
    """Write the page of a scene, atomically.

    Args:
        scene: of any kind; one with a colour network is coloured by it in the page, too.
        options: how it is drawn.
        staging: how it is shown.
        path: of the file.

    Raises:
        DyngsError: the file cannot be written.
    """
    lists = Lists()
    header = _header(scene, options, staging, lists)
    text = _assembled(header | {"layout": lists.layout}, lists.text(), staging)
    write_text(path, text)
    return WrittenPage(path, len(text.encode()), header)


def _header(scene: Scene, options: RenderOptions, staging: Staging, lists: Lists) -> dict[str, Any]:
    first = staging.views[0]
    apart = float((first.centers[0] - first.centers.new_tensor(staging.target)).norm())
    pixel = max(apart, 1e-6) / float(first.intrinsics[0, 1, 1])
    told = add_scene(scene, lists, TOLERANCE * pixel)
    shown = {
        "eps2d": options.eps2d,
        "near": options.near,
        "alphaMin": options.alpha_min,
        "antialiased": options.mode == RasterizeMode.ANTIALIASED,
        "background": list(staging.background),
        "target": list(staging.target),
        "up": list(staging.up),
        "seconds": staging.seconds,
        "time": staging.time,
        "views": [_view(camera) for camera in staging.views],
    }
    return told | shown


def _view(camera: Cameras) -> dict[str, Any]:
    (k,) = camera.intrinsics.tolist()
    return {
        "camFromWorld": camera.cam_from_world[0].flatten().tolist(),
        "intrinsics": [k[0][0], k[1][1], k[0][2], k[1][2]],
        "width": camera.width,
        "height": camera.height,
    }


def _assembled(header: dict[str, Any], numbers: str, staging: Staging) -> str:
    """Return the text of the page. All that stems from a run is escaped; scripts are allowed by their hash alone."""
    red, green, blue = (round(255 * min(max(x, 0.0), 1.0)) for x in staging.background)
    style = _file("page.css").replace("{{background}}", f"rgb({red}, {green}, {blue})")
    script = '"use strict";\n' + "\n".join(_file(name) for name in SCRIPTS)
    shaders = "\n".join(f'<script type="text/plain" id="{name}">\n{_file(name)}</script>' for name in SHADERS)
    page = _file("page.html")
    fixed = {"style": style, "script": script, "shaders": shaders}
    fixed |= {"style_hash": _hash(style), "script_hash": _hash(script), "title": html.escape(staging.title)}
    fixed |= {"header": _script_safe(header), "numbers": numbers}
    size = len(page) + sum(len(x) for x in fixed.values())
    fixed["about"] = f"{header['count']:,} Gaussians, {size / 1e6:.1f} MB"
    pieces = page.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:
        name, rest = piece.split("}}", 1)
        filled += [fixed[name], rest]
    return "".join(filled)


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Return how a Content-Security-Policy names an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _script_safe(value: Any) -> str:
    """Return JSON that cannot end the script element it stands in."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")
