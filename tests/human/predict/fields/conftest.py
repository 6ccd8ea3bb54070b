"""One small set of people for all tests of their fields."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_field_people import field_people, first_person

from dyngs.human.predict.people import Person


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return field_people(tmp_path_factory.mktemp("fields") / "people")


@pytest.fixture(scope="session")
def person(folder: Path) -> Person:
    return first_person(folder)
