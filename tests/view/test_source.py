from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.errors import DyngsError
from dyngs.view.source import first_of, is_network, open_source


def test_a_folder_of_runs_is_a_picker(tmp_path: Path) -> None:
    for name in ("b", "a/deep"):
        write_moving_run(tmp_path / name)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("model: 3")
    source = open_source(tmp_path)
    assert source.names == ("a/deep/run", "b/run")
    assert not source.load("b/run").is_static
    assert source.load("b/run").name == "b/run"
    next((tmp_path / "a/deep/run/checkpoints").iterdir()).write_bytes(b"damaged")
    first = first_of(source)
    assert first.name == "b/run"
    assert "left out" in first.notes[0]
    assert open_source(tmp_path / "b" / "run").names == ("run",)
    assert not is_network(tmp_path / "b" / "run")


def test_where_nothing_is_to_be_seen_one_line_says_so(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no runs there"):
        open_source(tmp_path)
    with pytest.raises(DyngsError, match="no such run"):
        open_source(tmp_path / "nothing")
