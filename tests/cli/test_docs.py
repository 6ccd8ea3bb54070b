"""``dyngs docs`` shows and lists the pages of the documentation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.cli.docs import docs_folder

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", ["install", "install.md", "start/install"])
def test_page_is_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs", name]) == 0
    assert capsys.readouterr().out == (DOCS / "start" / "install.md").read_text(encoding="utf-8")


def test_pages_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs"]) == 0
    listed = capsys.readouterr().out
    assert "\n  guides/photos\n" in listed


def test_guide_comes_before_a_concept_with_the_same_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, folder in (("people", "guides"), ("concepts/people", "concepts")):
        assert main(["docs", name, "--path"]) == 0
        assert Path(capsys.readouterr().out.strip()).parent.name == folder


def test_unknown_page_is_refused_with_a_similar_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs", "--path"]) == 0
    assert Path(capsys.readouterr().out.strip()) == docs_folder()
    assert main(["docs", "foto"]) == 2
    assert "did you mean 'photos'" in capsys.readouterr().err
    assert main(["docs", "../README"]) == 2


def test_package_contains_all_pages() -> None:
    project = (DOCS.parent / "pyproject.toml").read_text(encoding="utf-8")
    packed = re.findall(r'^"docs/(\S+)" = "dyngs/docs/\1"', project, re.MULTILINE)
    listed = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    for page in re.findall(r": (\S+\.md)$", listed, re.MULTILINE):
        assert page.split("/")[0] in packed, page


def test_api_page_has_signatures_and_docstrings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["docs", "reference/python"]) == 0
    shown = capsys.readouterr().out
    assert "dyngs.load = load(path" in shown
    assert ":::" not in shown
