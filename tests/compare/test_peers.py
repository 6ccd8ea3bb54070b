"""Figures of others: read as they are, or refused with their line."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.compare.peers import read_peers
from dyngs.errors import DyngsError


def test_rows_are_read_with_what_they_have(tmp_path: Path) -> None:
    path = tmp_path / "peers.csv"
    path.write_text('\ufeffmodel, source ,psnr,mb\n"NGP, big",paper,36.39,\nothers,me, ,3e1\n', encoding="utf-8")
    first, second = read_peers(path)
    assert (first.name, first.source, first.figures) == ("NGP, big", "paper", {"psnr": 36.39})
    assert second.figures == {"mb": 30.0}


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "no column 'model'"),
        ("model,psnr\nx,3\n", "no column 'source'"),
        ("model,source,psrn\nx,y,3\n", "unknown column 'psrn'"),
        ("model,source,source\nx,y,z\n", "names a column twice"),
        ("model,source,psnr\n", "has no rows"),
        ("model,source,psnr\nx,y,3\nx,y\n", "line 3: has not as many values"),
        ("model,source,psnr\nx,y,3,4\n", "line 2: has not as many values"),
        ("model,source,psnr\nx,,3\n", "line 2: say which model"),
        ("model,source,psnr\nx,y,inf\n", "line 2: psnr is 'inf', which is no number"),
        ('model,source,psnr\nx,"y,3\n', "cannot be read"),
        ("model,source,psnr\n" + 201 * "x,y,1\n", "201 rows"),
        ("model,source\n" + "x" * 2**20, "bytes"),
    ],
)
def test_anything_else_is_refused(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "peers.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DyngsError, match=r"peers\.csv") as error:
        read_peers(path)
    assert part in str(error.value)
