"""HTML pages that show a scene in a browser."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import format_count
from dyngs.data.geometry import estimate_focus
from dyngs.export.camera_paths import spread_rows
from dyngs.export.choose_path import (
    framing_points,
    frontal_cameras,
    orbit_cameras_around,
    select_view,
)
from dyngs.export.html.scene_data import PackedArrays, add_levels, add_scene, block_files
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.human.avatar.scene import as_human_scene
from dyngs.io.formats.similarity import AXES
from dyngs.io.outputs import atomic_folder, require_new_folder
from dyngs.io.write import write_text
from dyngs.models.views import training_cameras
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import OpenedScene


def fill_template(page: str, pieces: Mapping[str, str]) -> str:
    """Return ``page`` with each ``{{name}}`` replaced by the piece of that name. Pieces are
    inserted verbatim."""
    first, *remaining = page.split("{{")
    text = [first]
    for part in remaining:
        name, after = part.split("}}", 1)
        text += [pieces[name], after]
    return "".join(text)


def source_hash(text: str) -> str:
    """Return the Content-Security-Policy hash of an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def script_safe(value: Any) -> str:
    """Return JSON that cannot close the enclosing script element."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


PAGE, ELEMENT = "index.html", "dyngs-scene.js"  # files of a folder for a web server
TOLERANCE = 0.25  # Position error of fitted motion in pixels of the first view, at the orbit target


MOST_VIEWS = 24  # Most cameras of the capture offered on a page
_RING = 8  # Cameras around a scene without a capture


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk."""

    path: Path
    num_bytes: int  # total size of its files
    header: dict[str, Any]  # header of the page without the layout
    notes: tuple[str, ...]  # remarks for the user


def write_page(
    opened: OpenedScene,
    path: Path,
    *,
    folder: bool = False,
    most: int | None = None,
    title: str | None = None,
    time: float = 0.0,
    views: Sequence[Cameras] = (),
    view: str | None = None,
) -> WrittenPage:
    """Write a scene as a single HTML file or a folder for a web server, atomically.

    A folder holds ``PAGE``, ``ELEMENT`` for other pages, and data: blocks of levels of detail of a
    static scene, and time chunks of a long motion, are fetched when needed.

    Args:
        folder: write a new folder.
        most: largest number of Gaussians rendered of a static scene, for a folder.
        title: shown in a corner and in the title bar. None uses the name of the run or file.
        time: initial scene time.
        views: cameras offered on the page, each a batch of one, the first one initially. Empty uses
            those of the capture, or an orbit.
        view: name or index of the initial view of the capture, see ``select_view``.

    Raises:
        DyngsError: ``most`` for a moving scene, or the folder exists already.
    """
    collect_inputs(opened).require_output(path)
    if folder:
        require_new_folder(path)
    lists = PackedArrays(chunked=folder)
    cameras, target = _initial_views(opened, views, view)
    if folder and (most is not None or opened.renderable.has_levels):
        levelled = LevelScene.from_scene(opened.renderable, most)
        header = add_levels(levelled.levels, levelled.scene.colour, lists)
        header |= _render_header(levelled.options)
        header["levels"]["most"] = most
        parts = block_files(levelled.levels)
    else:
        header = _scene_header(opened, cameras[0], target, lists)
        parts = ((f"{i}.bin", chunk.deflated()) for i, chunk in enumerate(lists.chunks or ()))
    header |= _view_header(opened, time, cameras, target)
    text = _assemble_page(opened, header, lists, title)
    notes = _notes(opened, header)
    if not folder:
        write_text(path, text)
        return WrittenPage(path, len(text.encode()), header, notes)
    with atomic_folder(path) as started:
        write_text(started / PAGE, text)
        write_text(started / ELEMENT, element_script())
        for name, data in parts:
            (started / name).write_bytes(data)
        size = sum(file.stat().st_size for file in started.iterdir())
    return WrittenPage(path / PAGE, size, header, notes)


def _notes(opened: OpenedScene, header: dict[str, Any]) -> tuple[str, ...]:
    notes: list[str] = []
    if opened.missing is not None:
        notes.append(
            f"capture not found ({opened.missing}): the page starts with a view from outside"
        )
    if any(opened.world_offset):
        offset = " ".join(f"{x:.12g}" for x in opened.world_offset)
        notes.append(f"scene far from the origin: offset {offset} is subtracted")
    person = as_human_scene(opened.renderable)
    if person is not None:
        notes += person.left_out
    if not header.get("lines", {}).get("exact", True):
        notes.append("4D Gaussians are shown as predicted at their mean times, without a camera")
    curves = header.get("curves", {})
    if curves.get("error"):
        error = opened.frame.scale * curves["error"]
        fit = f"{curves['count']:,} x {curves['points']} control points, error {error:.2g} units"
        notes.append(f"motion fitted by splines ({fit})")
    return tuple(notes)


def _scene_header(
    opened: OpenedScene, first: Cameras, target: list[float], lists: PackedArrays
) -> dict[str, Any]:
    """Add the data of a scene to ``lists`` and return its header fields."""
    found = opened.renderable.page_data()
    if found is not None:
        header, own = found
        for name, (rows, bits) in own.items():
            lists.quantised(name, rows.detach().float().numpy(), bits)
        return header
    distance = float((first.centers[0] - first.centers.new_tensor(target)).norm()) or 1.0
    tolerance = TOLERANCE * distance / float(first.intrinsics[0, 1, 1])
    return add_scene(opened.scene, lists, tolerance) | _render_header(opened.scene.options)


def _initial_views(
    opened: OpenedScene, views: Sequence[Cameras], view: str | None
) -> tuple[Sequence[Cameras], list[float]]:
    """Return the cameras of the page, each a batch of one, and the orbit target.

    These are ``views`` if given, else cameras of the capture, else an orbit around the scene.
    """
    cameras = opened.cameras
    first = None if view is None else select_view(opened.capture, view)
    if not views and cameras is not None:
        capture = opened.capture
        distinct = {view.cam_from_world.tobytes(): view for view in capture.splits["train"][::-1]}
        others = list(distinct.values())[::-1]
        rows = spread_rows(len(others), MOST_VIEWS)
        chosen = (first or select_view(capture), *(others[i] for i in rows))
        return training_cameras(chosen, opened.config.data), estimate_focus(cameras).tolist()
    target = np.median(framing_points(opened.renderable).cpu().numpy(), axis=0)
    if not views:
        ring = orbit_cameras_around(opened, _RING)
        views = list(ring)
        if opened.person is not None:
            views = [frontal_cameras(opened).select(1), *views]
            target = estimate_focus(ring)
    return views, target.tolist()


def _view_header(
    opened: OpenedScene, time: float, views: Sequence[Cameras], target: list[float]
) -> dict[str, Any]:
    upward = np.array(AXES["z"]) if opened.up is None else opened.up[0]
    return {
        "near": opened.renderable.options.near,
        "background": opened.background.tolist(),
        "target": target,
        "up": upward.tolist(),
        "seconds": opened.seconds,
        "time": time,
        "views": [
            {
                "camFromWorld": camera.cam_from_world[0].flatten().tolist(),
                "intrinsics": camera.intrinsics[0, [0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                "width": camera.width,
                "height": camera.height,
            }
            for camera in views
        ],
    }


def _render_header(options: RenderOptions) -> dict[str, Any]:
    return {
        "eps2d": options.eps2d,
        "alphaMin": options.alpha_min,
        "antialiased": options.mode == RasterizeMode.ANTIALIASED,
    }


def _assemble_page(
    opened: OpenedScene, header: dict[str, Any], lists: PackedArrays, title: str | None
) -> str:
    """Return the text of the page. Texts of a run are escaped, and scripts are allowed by hash
    only."""
    if title is None:
        title = opened.name if opened.captured is not None else Path(opened.name).stem
    red, green, blue = (round(255 * min(max(x, 0.0), 1.0)) for x in header["background"])
    style = read_asset("page.css").replace("{{background}}", f"rgb({red}, {green}, {blue})")
    script = element_script()
    page = read_asset("page.html")
    fetches = "levels" in header or "chunk" in header.get("curves", {})
    fixed = {
        "style": style,
        "script": script,
        "style_hash": source_hash(style),
        "script_hash": source_hash(script),
        "title": html.escape(title),
        "header": script_safe(header | {"layout": lists.layout}),
        "numbers": lists.text(),
        "fetched": " connect-src 'self';" if fetches else "",  # only its own files
    }
    size = len(page) + sum(len(x) for x in fixed.values())
    about = format_count(header["count"], "triangle" if "texture" in header else "Gaussian")
    return fill_template(
        page, fixed | {"about": about + ("" if fetches else f", {size / 1e6:.1f} MB")}
    )


SCRIPTS = (
    "fetched.js",
    "data.js",
    "chunks.js",
    "motion.js",
    "sort.js",
    "drawing.js",
    "renderer.js",
    "levels.js",
)
SCRIPTS += ("triangles.js", "camera.js", "player.js", "controls.js", "element.js")
SHADERS = ("project.glsl", "splat.vert.glsl", "splat.frag.glsl", "copy.vert.glsl", "copy.frag.glsl")
SHADERS += ("harmonics.glsl", "triangles.vert.glsl", "triangles.frag.glsl")


def element_script() -> str:
    """Return the script of the custom element: self-contained, without globals, in ASCII."""
    texts = {
        "STYLE": read_asset("scene.css"),
        "SHADERS": {name: read_asset(name) for name in SHADERS},
    }
    constants = [f"const {name} = {script_safe(value)};" for name, value in texts.items()]
    parts = "\n".join([*constants, *map(read_asset, SCRIPTS)])
    script = f'// <dyngs-scene src="PAGE">: a scene of dyngs (Apache-2.0).\n(() => {{\n"use strict";\n{parts}}})();\n'
    return script.encode("ascii", "backslashreplace").decode("ascii")


def read_asset(name: str) -> str:
    """Return the text of a file in this folder."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")
