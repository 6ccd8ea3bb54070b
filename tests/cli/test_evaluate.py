"""``dyngs eval``: what it says before it begins."""

from pathlib import Path

import pytest

from dyngs.cli import main


def test_what_is_no_run_is_refused_in_one_line_before_anything_is_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(tmp_path), "--refine"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "not a run folder" in line
