from pathlib import Path

import pytest
from tiny_people import NET, people

import dyngs
from dyngs.errors import DyngsError
from dyngs.view.network import open_network
from dyngs.view.people import person_in
from dyngs.view.source import is_network, open_source


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a person, and a network that has hardly been trained on them."""
    root = tmp_path_factory.mktemp("network")
    options = [f"data.root={people(root / 'people', (1,))}", f"run.dir={root / 'net'}", "train.steps=1"]
    options += [f"model.{name}={getattr(NET, name)}" for name in ("resolution", "source_views", "target_views")]
    options += ["model.source_sets=1", "model.widths=[8, 8]", "run.threads=1"]
    dyngs.train(dyngs.load_config("human_predictor", options))
    return root


def test_a_person_is_predicted_from_the_images_that_are_picked(folder: Path) -> None:
    assert is_network(folder / "net")
    source = open_source(folder / "net")
    assert source.network is not None
    person = source.names[0]
    names = source.network.images_of(person)
    viewed = source.network.predict(person, names[:2])
    assert person_in(viewed) is not None
    assert all(name in viewed.notes[-1] for name in names[:2])


def test_one_person_may_be_given(folder: Path) -> None:
    one = next((folder / "people").iterdir())
    assert list(open_network(folder / "net", one).people) == [one.name]
    with pytest.raises(DyngsError, match="--capture goes with"):
        open_source(folder / "people", capture=one)
