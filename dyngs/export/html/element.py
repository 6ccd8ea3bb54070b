"""The script that defines ``<dyngs-scene src="PAGE">``, which draws our pages and stands in those
of others."""

from __future__ import annotations

from pathlib import Path

from dyngs.export.html.template import script_safe

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
    """Return the script: it needs nothing else, leaves no other name behind, and is ASCII, as pages
    may be of any."""
    texts = {"STYLE": text_of("scene.css"), "SHADERS": {name: text_of(name) for name in SHADERS}}
    constants = [f"const {name} = {script_safe(value)};" for name, value in texts.items()]
    parts = "\n".join([*constants, *map(text_of, SCRIPTS)])
    script = f'// <dyngs-scene src="PAGE">: a scene of dyngs (Apache-2.0).\n(() => {{\n"use strict";\n{parts}}})();\n'
    return script.encode("ascii", "backslashreplace").decode("ascii")


def text_of(name: str) -> str:
    """Return a file of this folder."""
    return (Path(__file__).parent / name).read_text(encoding="utf-8")
