from pathlib import Path

import pytest
from moving_scene import write_moving_run
from tiny_people import NET, people

import dyngs
from dyngs.core.errors import DyngsError
from dyngs.view.source import first_of, is_network, open_network, open_source


def test_a_folder_of_runs_is_a_picker(tmp_path: Path) -> None:
    for name in ("b", "a/deep"):
        write_moving_run(tmp_path / name)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.yaml").write_text("model: 3")
    source = open_source(tmp_path)
    assert source.names == ("a/deep/run", "b/run")
    assert not source.load("b/run").scene.is_static
    assert source.load("b/run").name == "b/run"
    next((tmp_path / "a/deep/run/checkpoints").iterdir()).write_bytes(b"damaged")
    first = first_of(source)
    assert first.name == "b/run"
    assert "left out" in first.notes[0]
    assert open_source(tmp_path / "b" / "run").names == ("run",)
    assert not is_network(tmp_path / "b" / "run")


def test_levels_are_for_still_scenes(tmp_path: Path) -> None:
    still, moving = (
        write_moving_run(tmp_path / name, moves=name == "moving") for name in ("still", "moving")
    )
    assert "at most 9 Gaussians" in first_of(open_source(still, most=9)).notes[-1]
    with pytest.raises(DyngsError, match="for still scenes"):
        first_of(open_source(moving, most=9))


def test_where_nothing_is_to_be_seen_one_line_says_so(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no runs there"):
        open_source(tmp_path)
    with pytest.raises(DyngsError, match="no such run"):
        open_source(tmp_path / "nothing")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a person, and a network that has hardly been trained on them."""
    root = tmp_path_factory.mktemp("network")
    options = [
        f"data.root={people(root / 'people', (1,))}",
        f"run.dir={root / 'net'}",
        "train.steps=1",
    ]
    options += [
        f"model.{name}={getattr(NET, name)}"
        for name in ("resolution", "source_views", "target_views")
    ]
    options += ["model.source_sets=1", "model.widths=[8, 8]", "run.threads=1"]
    dyngs.train(dyngs.load_config("human_predictor", options))
    return root


def test_a_person_is_predicted_from_the_images_that_are_picked(folder: Path) -> None:
    assert is_network(folder / "net")
    source = open_source(folder / "net")
    assert source.network is not None
    person = source.names[0]
    names = source.network.images_of(person)
    opened = source.network.predict(person, names[:2])
    assert opened.person is not None
    assert all(name in opened.notes[-1] for name in names[:2])


def test_one_person_may_be_given(folder: Path) -> None:
    one = next((folder / "people").iterdir())
    assert list(open_network(folder / "net", one).people) == [one.name]
    with pytest.raises(DyngsError, match="--capture goes with"):
        open_source(folder / "people", capture=one)
