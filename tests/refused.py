"""Command lines that must be refused."""

from __future__ import annotations

import pytest

from dyngs.cli import main


def error_line(capsys: pytest.CaptureFixture[str], *arguments: object, begun: bool = False) -> str:
    """Return the one line that a refused command prints on stderr. stdout is empty, unless the
    command has ``begun``."""
    capsys.readouterr()  # of earlier commands
    assert main([str(a) for a in arguments]) == 2
    output = capsys.readouterr()
    assert output.err.startswith("dyngs: error: ")
    assert output.err.count("\n") == 1
    assert begun or output.out == ""
    return output.err
