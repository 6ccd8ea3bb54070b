"""A small capture shared by the tests of curved triangles."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.data.synthetic.captures import StaticOptions, write_static_capture


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """16 views of an object on a transparent background, 24 px."""
    folder = tmp_path_factory.mktemp("triangles") / "capture"
    write_static_capture(folder, StaticOptions(size=24, num_train=16, num_test=2, samples=2))
    return folder
