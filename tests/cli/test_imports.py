"""The garbage collector at imports of what is heavy."""

from __future__ import annotations

import gc
import sys

import pytest

from dyngs.cli.imports import heavy_imports


def test_the_collector_rests_during_imports_and_forgets_what_they_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "torch")  # as at the start of a command
    frozen = gc.get_freeze_count()
    with heavy_imports():
        assert not gc.isenabled()
        kept = [[] for _ in range(100_000)]
    assert gc.isenabled()
    # half, as what was frozen before may be freed meanwhile
    assert gc.get_freeze_count() > frozen + len(kept) // 2


def test_the_collector_stays_as_it_is_where_torch_is_there_already() -> None:
    frozen = gc.get_freeze_count()
    with heavy_imports():
        assert gc.isenabled()
        kept = [[] for _ in range(1000)]
    # What was frozen before can be freed at any moment, so the count may fall; it must not take up
    # what is new.
    assert gc.get_freeze_count() < frozen + len(kept)


def test_the_collector_goes_on_after_an_import_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "torch")
    with pytest.raises(ImportError), heavy_imports():
        raise ImportError
    assert gc.isenabled()
