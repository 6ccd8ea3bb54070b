"""The fixtures of ``shared.py``, in each process that runs tests."""

from __future__ import annotations

import pytest


def pytest_configure(config: pytest.Config) -> None:
    """The process that hands out tests, as ``pytest -n 2`` starts one, runs none: torch it need not import."""
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        config.pluginmanager.import_plugin("shared")
