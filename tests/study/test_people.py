"""Networks are compared on people from the same views, and with views that none of them was
given."""

from __future__ import annotations

import csv
from itertools import pairwise
from pathlib import Path

import pytest
from tiny_stereo import PEOPLE, stereo_config, stereo_people

from dyngs.api.train import train
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.read import captures_in, read_capture
from dyngs.human.predict.gps.rectification import angle
from dyngs.study.people import PeopleBench, compare_people, task_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stereo_people(tmp_path_factory.mktemp("people") / "set")


@pytest.fixture(scope="module")
def network(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(stereo_config(folder, tmp_path_factory.mktemp("run") / "net"))


@pytest.mark.parametrize("spread", [False, True])
def test_nobody_is_given_what_is_compared_with(folder: Path, spread: bool) -> None:
    views = read_capture(captures_in(DataConfig(root=folder, test_every=0))[0]).splits["train"]
    sources, targets = task_of(views, (), 3, 5, spread)
    assert len(sources) == len(set(sources)) == 3
    assert len(targets) == (3 if spread else 2)
    assert not {views[i].name for i in sources} & {view.name for view in targets}
    apart = [angle(views[a], views[b]) for a, b in pairwise(sources)]
    # directions tilt towards the person, which makes angles less than those around the ring
    assert all((90 if spread else 25) < x < (121 if spread else 31) for x in apart)
    nearest = [min(angle(views[i], view) for i in sources) for view in targets]
    assert all((45 if spread else 12) < x < (61 if spread else 16) for x in nearest)


def test_a_table_scores_and_pictures(
    network: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same views give the same scores; what does not suit is told and left out."""
    bench = PeopleBench(folder, [network], (2, 3), data=("longest_side=32",))
    table = compare_people(bench, tmp_path / "out")
    ((name, two, three, *_),) = table.cells
    assert (table.head[:3], name) == (["method", "2 views", "3 views"], "net")
    assert "left out" not in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out" / "comparison.csv").read_text().splitlines()))
    assert [row["count"] for row in rows] == ["2", "3", "3"] * PEOPLE.people
    assert two.startswith(
        f"{sum(float(row['psnr']) for row in rows if row['count'] == '2') / PEOPLE.people:.2f} dB"
    )
    assert three != two
    assert len([*(tmp_path / "out" / "pictures").iterdir()]) == len(rows)
    assert f"| net | {two} | {three} |" in (tmp_path / "out" / "comparison.md").read_text()
    with pytest.raises(DyngsError, match="nothing could be predicted"):
        compare_people(PeopleBench(folder, [network], (2,), spread=True), tmp_path / "other")
    said = [line for line in capsys.readouterr().out.splitlines() if "net left out: " in line]
    assert all("degrees apart" in line for line in said)
    assert len(said) == PEOPLE.people
    assert not (tmp_path / "other").exists()


def test_networks_of_the_same_name_are_not_mixed(
    network: Path, folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(DyngsError, match="two networks are named net"):
        compare_people(
            PeopleBench(folder, [network, tmp_path / "other" / "net"], (2,)), tmp_path / "out"
        )
    assert not (tmp_path / "out").exists()
