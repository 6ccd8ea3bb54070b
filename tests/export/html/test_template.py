"""The shaders have the uniforms that the script sets: WebGL says nothing of a wrong name, and the
page stays black."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from dyngs.export import html

FOLDER = files(html)
MAIN = r'(?<!\.)\bat\("(\w+)(?:\[0\])?"\)|list\("(\w+)"'
COPY = r'copy\.at\("(\w+)"\)'
SET = [
    ("renderer.js", "project.", MAIN),
    ("renderer.js", "splat.", r'splat\.at\("(\w+)"\)'),
    ("renderer.js", "copy.", COPY),
    ("triangles.js", "triangles.", MAIN),
    ("triangles.js", "copy.", COPY),
]
HARMONICS = {"uHarmonics"}  # set by drawing.js for both


@pytest.mark.parametrize(("program", "shader", "names"), SET)
def test_the_script_sets_the_uniforms_that_a_shader_has(
    program: str, shader: str, names: str
) -> None:
    script = (FOLDER / program).read_text(encoding="utf-8")
    paths = [
        path
        for path in FOLDER.iterdir()
        if path.name.startswith(shader) and path.name.endswith(".glsl")
    ]
    declared = {
        name
        for path in paths
        for name in re.findall(r"\buniform (?:\w+ )+(\w+)", path.read_text("utf-8"))
    }
    given = {name for found in re.finditer(names, script) for name in found.groups() if name}
    assert declared
    assert given == declared - HARMONICS
