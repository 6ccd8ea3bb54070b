"""Command lines that must be refused."""

from __future__ import annotations

import pytest

from dyngs.cli import main


def error_line(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What stderr says about a command line that must be refused: one line."""
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("dyngs: error: ")
    assert error.count("\n") == 1
    return error
