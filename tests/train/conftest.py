"""Tiny captures that several tests of training share."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_fields import write_tiny_capture

from dyngs.data.synthetic import StillOptions, write_still_capture
from dyngs.human.synthetic import HumanOptions, write_human_capture


@pytest.fixture(scope="session")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures of 16 px; nothing moves."""
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


@pytest.fixture(scope="session")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Something moves."""
    return write_tiny_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture(scope="session")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cameras, three frames of 32 px."""
    folder = tmp_path_factory.mktemp("capture") / "person"
    return write_human_capture(folder, HumanOptions(size=32, num_frames=3, num_new=2, num_cameras=3, num_test=1))
