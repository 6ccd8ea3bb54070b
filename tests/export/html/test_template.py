"""The shaders have the uniforms that the script sets: WebGL says nothing of a wrong name, and the page stays black."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from dyngs.export import html

FOLDER = files(html)
SET = {
    "project.glsl": r'(?<!\.)\bat\("(\w+)(?:\[0\])?"\)|list\("(\w+)"',
    "splat.": r'splat\.at\("(\w+)"\)',
    "copy.": r'copy\.at\("(\w+)"\)',
}


@pytest.mark.parametrize("shader", list(SET))
def test_the_script_sets_the_uniforms_that_a_shader_has(shader: str) -> None:
    script = (FOLDER / "renderer.js").read_text(encoding="utf-8")
    texts = [path.read_text(encoding="utf-8") for path in FOLDER.iterdir() if path.name.startswith(shader)]
    declared = {name for text in texts for name in re.findall(r"\buniform (?:\w+ )+(\w+)", text)}
    given = {name for found in re.finditer(SET[shader], script) for name in found.groups() if name}
    assert declared
    assert given == declared
