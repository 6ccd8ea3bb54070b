"""The page of a scene: one file with everything in it, which asks no host for anything."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import counted
from dyngs.data.aim import look_at_point
from dyngs.data.capture import Capture, View
from dyngs.deform.bodies.field import bodies_of
from dyngs.deform.scene import field_scene_of
from dyngs.export.choose_path import in_front_of, orbit_around, points_at, view_to_show
from dyngs.export.html.element import element_script, text_of
from dyngs.export.html.numbers import Lists, add_levels, add_scene, add_triangles, block_files
from dyngs.export.html.template import filled, script_safe, source_hash
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.static_scene import StaticScene
from dyngs.human.avatar.scene import avatar_of
from dyngs.io.formats.similarity import AXES
from dyngs.io.outputs import new_folder, require_new_folder
from dyngs.io.write import write_text
from dyngs.models.views import training_cameras
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened

PAGE, ELEMENT = "index.html", "dyngs-scene.js"  # in a folder for a web server
# pixels of the first view that a place at its target may be off where motion is fitted
TOLERANCE = 0.25


MOST_VIEWS = 24  # cameras of the capture that a page offers, evenly chosen
_RING, _FRONT_RING = 8, 24
"""Cameras around a scene without a capture; among how many the front of a person is looked for."""


@dataclass(frozen=True)
class WrittenPage:
    """A page on disk."""

    path: Path  # of it
    num_bytes: int  # its size, with those of all files of its folder
    header: dict[str, Any]  # what it says except for the layout
    notes: tuple[str, ...]  # lines about what was chosen or left out


def write_page(
    opened: Opened,
    path: Path,
    *,
    title: str | None = None,
    time: float = 0.0,
    views: Sequence[Cameras] = (),
) -> WrittenPage:
    """Write the page of a scene, atomically: where its viewer begins, and what moves.

    ``title``: shown in a corner and in the title bar; None: the name of the run, or of the file.
    ``views``: cameras to begin with and to go through, each a batch of one; without any, those of
    the capture, or around the scene.
    """
    inputs_of(opened).require_output(path)
    lists = Lists()
    header = _header(opened, time, views, lists)
    text = _assembled(header | {"layout": lists.layout}, lists.text(), _title(opened, title))
    write_text(path, text)
    return WrittenPage(path, len(text.encode()), header, _notes(opened, header))


def write_folder(
    opened: Opened,
    folder: Path,
    *,
    most: int | None = None,
    title: str | None = None,
    time: float = 0.0,
    views: Sequence[Cameras] = (),
) -> WrittenPage:
    """Write a new folder for a web server: ``PAGE``, ``ELEMENT`` for other pages, and what is
    fetched when it is seen.

    That is a still scene in blocks of its levels of detail, and a long motion in chunks of time.
    ``most``: Gaussians of a still scene that are drawn at most. Others as of ``write_page``. Raises
    DyngsError: ``most`` of another scene, or a folder that exists already.
    """
    require_new_folder(folder)
    lists = Lists(chunked=True)
    if most is not None or isinstance(opened.renderable, StaticScene):
        levelled = LevelScene.of(opened.renderable, most)
        levels = levelled.levels
        colour = levelled.scene.colour
        header = add_levels(levels, colour, lists) | _drawn(levelled.options)
        header["levels"]["most"] = most
        header |= _shown(opened, time, *_beginning(opened, views))
        parts = block_files(levels, with_rest=colour is None)
    else:
        header = _header(opened, time, views, lists)
        parts = ((f"{i}.bin", chunk.deflated()) for i, chunk in enumerate(lists.chunks or ()))
    text = _assembled(header | {"layout": lists.layout}, lists.text(), _title(opened, title))
    with new_folder(folder) as started:
        write_text(started / PAGE, text)
        write_text(started / ELEMENT, element_script())
        for name, data in parts:
            (started / name).write_bytes(data)
        size = sum(file.stat().st_size for file in started.iterdir())
    return WrittenPage(folder / PAGE, size, header, _notes(opened, header))


def _title(opened: Opened, title: str | None) -> str:
    if title is not None:
        return title
    return opened.name if opened.captured is not None else Path(opened.name).stem


def _notes(opened: Opened, header: dict[str, Any]) -> tuple[str, ...]:
    notes: list[str] = []
    if opened.captured is not None and opened.missing is not None:
        up = "" if opened.person is not None else f", {opened.stated_up or 'z'} up"
        notes.append(
            f"without the capture ({opened.missing}) the page begins with a view from outside{up}"
        )
    if any(opened.world_offset):
        offset = " ".join(f"{x:.12g}" for x in opened.world_offset)
        notes.append(f"the scene is far from the origin: {offset} is subtracted from its positions")
    person = avatar_of(opened.renderable)
    if person is not None:
        notes += person.left_out
    curves = header.get("curves", {})
    if curves.get("error"):
        error = opened.frame.scale * curves["error"]
        fit = f"{curves['points']} control points for each of {curves['count']:,}, off by {error:.2g} units"
        notes.append(f"splines are fitted to the motion ({fit})")
    moved = field_scene_of(opened.renderable)
    if moved is not None and bodies_of(moved.field) is not None:
        notes.append("shadows of bodies that turn are left out")
    return tuple(notes)


def _header(opened: Opened, time: float, views: Sequence[Cameras], lists: Lists) -> dict[str, Any]:
    views, target = _beginning(opened, views)
    if isinstance(opened.renderable, TriangleScene):
        told = add_triangles(opened.renderable, lists)
    else:
        apart = float((views[0].centers[0] - views[0].centers.new_tensor(target)).norm())
        pixel = (apart or 1.0) / float(views[0].intrinsics[0, 1, 1])
        told = add_scene(opened.scene, lists, TOLERANCE * pixel) | _drawn(opened.scene.options)
    return told | _shown(opened, time, views, target)


def _beginning(opened: Opened, views: Sequence[Cameras]) -> tuple[Sequence[Cameras], list[float]]:
    """Return the cameras of a page, ``views`` if there are any, and the point to look at."""
    return (views, _middle(opened)) if views else _views(opened)


def _shown(
    opened: Opened, time: float, views: Sequence[Cameras], target: list[float]
) -> dict[str, Any]:
    upward = np.array(AXES["z"]) if opened.up is None else opened.up[0]
    return {
        "near": opened.renderable.options.near,
        "background": opened.background.tolist(),
        "target": target,
        "up": upward.tolist(),
        "seconds": opened.seconds,
        "time": time,
        "views": [_view(camera) for camera in views],
    }


def _drawn(options: RenderOptions) -> dict[str, Any]:
    return {
        "eps2d": options.eps2d,
        "alphaMin": options.alpha_min,
        "antialiased": options.mode == RasterizeMode.ANTIALIASED,
    }


def _views(opened: Opened) -> tuple[list[Cameras], list[float]]:
    """Return the cameras to begin with and to go through, each a batch of one, and the point to
    look at."""
    cameras = opened.cameras
    if cameras is not None:
        capture = opened.capture
        chosen = (view_to_show(capture), *_some(capture))
        return training_cameras(chosen, opened.config.data), look_at_point(cameras).tolist()
    ring = orbit_around(opened, _RING)
    views = [ring.select(i) for i in range(_RING)]
    if opened.person is None:
        return views, _middle(opened)
    return [in_front_of(opened).select(1), *views], look_at_point(ring).tolist()


def _middle(opened: Opened) -> list[float]:
    return np.median(points_at(opened.renderable).cpu().numpy(), axis=0).tolist()


def _some(capture: Capture) -> list[View]:
    views = []
    seen = set()
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
    """Return the text of the page. All that stems from a run is escaped; scripts are allowed by
    their hash alone."""
    red, green, blue = (round(255 * min(max(x, 0.0), 1.0)) for x in header["background"])
    style = text_of("page.css").replace("{{background}}", f"rgb({red}, {green}, {blue})")
    script = element_script()
    page = text_of("page.html")
    fixed = {"style": style, "script": script}
    fixed |= {
        "style_hash": source_hash(style),
        "script_hash": source_hash(script),
        "title": html.escape(title),
    }
    fixed |= {"header": script_safe(header), "numbers": numbers}
    size = len(page) + sum(len(x) for x in fixed.values())
    kind = "triangle" if "texture" in header else "Gaussian"
    fetches = "levels" in header or "chunk" in header.get("curves", {})
    fixed["about"] = counted(header["count"], kind) + ("" if fetches else f", {size / 1e6:.1f} MB")
    fixed["fetched"] = " connect-src 'self';" if fetches else ""  # nothing, but for its parts
    return filled(page, fixed)
