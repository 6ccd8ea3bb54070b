"""``dyngs docs`` shows the pages of the documentation, whose links lead to files that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.cli.docs import docs_folder

ROOT = Path(__file__).parents[2]


def test_pages_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs"]) == 0
    assert "# Documentation" in capsys.readouterr().out
    for topic in ("longer", "longer.md"):
        assert main(["docs", topic]) == 0
        shown = capsys.readouterr().out
        assert shown == (ROOT / "docs" / "longer.md").read_text(encoding="utf-8")
    assert main(["docs", "--path"]) == 0
    assert Path(capsys.readouterr().out.strip()) == docs_folder()
    assert main(["docs", "foto"]) == 2
    assert "did you mean 'photos'" in capsys.readouterr().err
    assert main(["docs", "../README"]) == 2


def test_links_lead_to_what_is_installed() -> None:
    """All of docs, and what its pages link to outside of it, goes into the package."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    packed = dict(re.findall(r'^"(\S+)" = "(dyngs/\S+)"', project, re.MULTILINE))
    assert packed["docs"] == "dyngs/docs"
    for page in sorted((ROOT / "docs").rglob("*.md")):
        for target in re.findall(
            r"\]\(([^)#\s:]+)(?:#[^)\s]*)?\)", page.read_text(encoding="utf-8")
        ):
            place = (page.parent / target).resolve()
            assert place.exists(), (page, target)
            inside = place.relative_to(ROOT).as_posix()
            assert inside.startswith("docs/") or packed[inside] == f"dyngs/{inside}", (page, target)
