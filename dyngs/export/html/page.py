"""The page of a scene: one file with everything in it, which asks no host for anything."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.camera import Cameras
from dyngs.camera_paths.aim import look_at_point
from dyngs.conventions import RasterizeMode
from dyngs.data.capture import Capture, View
from dyngs.deform.bodies.field import bodies_of
from dyngs.deform.scene import field_scene_of
from dyngs.errors import counted
from dyngs.export.chosen_path import front_of, orbit_around, points_at, view_to_show
from dyngs.export.html.numbers import Lists, add_scene, add_triangles
from dyngs.export.html.template import filled, script_safe, source_hash
from dyngs.files.write import write_text
from dyngs.gaussians.rendering import RenderOptions
from dyngs.human.avatar.posing import LEFT_OUT
from dyngs.models.views import training_cameras
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened
from dyngs.splats.rotation import AXES
from dyngs.triangles.scene import TriangleScene

HERE = Path(__file__).parent
SCRIPTS = ("data.js", "motion.js", "sort.js", "drawing.js", "renderer.js", "triangles.js", "camera.js", "player.js")
SCRIPTS += ("main.js",)
SHADERS = ("project.glsl", "splat.vert.glsl", "splat.frag.glsl", "copy.vert.glsl", "copy.frag.glsl")
SHADERS += ("harmonics.glsl", "triangles.vert.glsl", "triangles.frag.glsl")
TOLERANCE = 0.25  # pixels of the first view that a place at its target may be off where motion is fitted


MOST_VIEWS = 24  # cameras of the capture that a page offers, evenly chosen
_RING, _FRONT_RING = 8, 24
"""Cameras around a scene without a capture; among how many the front of a person is looked for."""


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk."""

    path: Path  # of it
    num_bytes: int  # its size
    header: dict[str, Any]  # what it says except for the layout
    notes: tuple[str, ...]  # lines about what was chosen or left out


def write_page(
    opened: Opened, path: Path, *, title: str | None = None, time: float = 0.0, views: Sequence[Cameras] = ()
) -> WrittenPage:
    """Write the page of a scene, atomically: where its viewer begins, and what moves.

    ``title``: shown in a corner and in the title bar; None: the name of the run, or of the file. ``views``: cameras to
    begin with and to go through, each a batch of one; without any, those of the capture, or around the scene.
    """
    inputs_of(opened).require_output(path)
    if title is None:
        title = opened.name if opened.captured is not None else Path(opened.name).stem
    lists = Lists()
    header = _header(opened, time, views, lists)
    text = _assembled(header | {"layout": lists.layout}, lists.text(), title)
    write_text(path, text)
    return WrittenPage(path, len(text.encode()), header, _notes(opened, header))


def _notes(opened: Opened, header: dict[str, Any]) -> tuple[str, ...]:
    notes: list[str] = []
    if opened.captured is not None and opened.missing is not None:
        up = "" if opened.person is not None else f", {opened.stated_up or 'z'} up"
        notes.append(f"without the capture ({opened.missing}) the page begins with a view from outside{up}")
    if opened.person is not None and opened.person.light is not None:
        notes.append(LEFT_OUT)
    curves = header.get("curves", {})
    if curves.get("error"):
        fit = f"{curves['points']} control points for each of {curves['count']:,}, off by {curves['error']:.2g}"
        notes.append(f"splines are fitted to the motion ({fit} world units)")
    moved = field_scene_of(opened.renderable)
    if moved is not None and bodies_of(moved.field) is not None:
        notes.append("shadows of bodies that turn are left out")
    return tuple(notes)


def _header(opened: Opened, time: float, views: Sequence[Cameras], lists: Lists) -> dict[str, Any]:
    views, target = (views, _middle(opened)) if views else _views(opened)
    upward = np.array(AXES["z"]) if opened.up is None else opened.up[0]
    if isinstance(opened.renderable, TriangleScene):
        told = add_triangles(opened.renderable, lists)
    else:
        apart = float((views[0].centers[0] - views[0].centers.new_tensor(target)).norm())
        pixel = max(apart, 1e-6) / float(views[0].intrinsics[0, 1, 1])
        told = add_scene(opened.scene, lists, TOLERANCE * pixel) | _drawn(opened.scene.options)
    shown = {
        "near": opened.renderable.options.near,
        "background": opened.background.tolist(),
        "target": target,
        "up": upward.tolist(),
        "seconds": opened.seconds,
        "time": time,
        "views": [_view(camera) for camera in views],
    }
    return told | shown


def _drawn(options: RenderOptions) -> dict[str, Any]:
    return {
        "eps2d": options.eps2d,
        "alphaMin": options.alpha_min,
        "antialiased": options.mode == RasterizeMode.ANTIALIASED,
    }


def _views(opened: Opened) -> tuple[list[Cameras], list[float]]:
    """Return the cameras to begin with and to go through, each a batch of one, and the point to look at."""
    cameras = opened.cameras
    if cameras is not None:
        capture = opened.capture
        chosen = (view_to_show(capture), *_some(capture))
        return training_cameras(chosen, opened.config.data), look_at_point(cameras).tolist()
    ring = orbit_around(opened, _RING)
    views = [ring.select(i) for i in range(_RING)]
    if opened.person is None:
        return views, _middle(opened)
    wide = orbit_around(opened, _FRONT_RING)
    return [wide.select(front_of(opened, wide)), *views], look_at_point(ring).tolist()


def _middle(opened: Opened) -> list[float]:
    return np.median(points_at(opened.renderable).cpu().numpy(), axis=0).tolist()


def _some(capture: Capture) -> list[View]:
    views, seen = [], set()
    for view in capture.splits["train"]:
        pose = view.cam_from_world.tobytes()
        if pose not in seen:
            seen.add(pose)
            views.append(view)
    rows = np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().astype(int)
    return [views[i] for i in rows]


def _view(camera: Cameras) -> dict[str, Any]:
    (k,) = camera.intrinsics.tolist()
    return {
        "camFromWorld": camera.cam_from_world[0].flatten().tolist(),
        "intrinsics": [k[0][0], k[1][1], k[0][2], k[1][2]],
        "width": camera.width,
        "height": camera.height,
    }


def _assembled(header: dict[str, Any], numbers: str, title: str) -> str:
    """Return the text of the page. All that stems from a run is escaped; scripts are allowed by their hash alone."""
    red, green, blue = (round(255 * min(max(x, 0.0), 1.0)) for x in header["background"])
    style = _file("page.css").replace("{{background}}", f"rgb({red}, {green}, {blue})")
    script = '"use strict";\n' + "\n".join(_file(name) for name in SCRIPTS)
    shaders = "\n".join(f'<script type="text/plain" id="{name}">\n{_file(name)}</script>' for name in SHADERS)
    page = _file("page.html")
    fixed = {"style": style, "script": script, "shaders": shaders}
    fixed |= {"style_hash": source_hash(style), "script_hash": source_hash(script), "title": html.escape(title)}
    fixed |= {"header": script_safe(header), "numbers": numbers}
    size = len(page) + sum(len(x) for x in fixed.values())
    kind = "triangle" if "texture" in header else "Gaussian"
    fixed["about"] = f"{counted(header['count'], kind)}, {size / 1e6:.1f} MB"
    return filled(page, fixed)


def _file(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")
