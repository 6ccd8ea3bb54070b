"""A folder of people is not taken for a folder of photos."""

from __future__ import annotations

from pathlib import Path

from tiny_people import NET, people

from dyngs.api.before_training import with_capture
from dyngs.config import Config


def test_the_captures_of_a_network_are_left_as_they_are(tmp_path: Path) -> None:
    """The folder of captures is itself no capture, and holds many images below."""
    root = people(tmp_path, (1,))
    config = Config.model_validate({"data": {"root": root}, "model": NET})
    assert with_capture(config) == config
