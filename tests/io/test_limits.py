"""The limits of files from others, and the variable that raises them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.containment import LIMITS_VARIABLE, require_at_most, scaled_limit
from dyngs.io.fields import read_limited


def test_what_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LIMITS_VARIABLE, raising=False)
    assert scaled_limit(100) == 100
    require_at_most(Path("a.x"), 100, 100, "things")
    line = r"a\.x: 1,001 things exceed the limit of 100; .* DYNGS_LIMITS=11$"
    with pytest.raises(DyngsError, match=line):
        require_at_most(Path("a.x"), 1001, 100, "things")
    monkeypatch.setenv(LIMITS_VARIABLE, "11")
    require_at_most(Path("a.x"), 1001, 100, "things")
    with pytest.raises(DyngsError, match=r"over 10\^18 things exceed the limit of 1,100; .*=N"):
        require_at_most(Path("a.x"), 10**5000, 100, "things")


@pytest.mark.parametrize("text", ["", "x", "nan", "0", "-1", "0.5", "inf", "1e300"])
def test_a_variable_that_means_nothing(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LIMITS_VARIABLE, text)
    with pytest.raises(DyngsError, match=r"DYNGS_LIMITS=.* must be a factor from 1 to 1e6"):
        scaled_limit(1)


def test_a_file_is_read_up_to_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.txt"
    file.write_bytes(b"12345")
    assert read_limited(file, 5) == b"12345"
    with pytest.raises(
        DyngsError, match=r"a\.txt: 5 bytes exceed the limit of 4; .*DYNGS_LIMITS=2"
    ):
        read_limited(file, 4)
    monkeypatch.setenv(LIMITS_VARIABLE, "2")
    assert read_limited(file, 4) == b"12345"
