"""A network of people in the viewer: the people that it may predict, and from which of their images."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from dyngs.api.predict import network_config, predict_person
from dyngs.config import DataConfig
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.runs.checkpoint import load_run
from dyngs.training.prediction import captures_in
from dyngs.view.viewed import Viewed, viewed_run

MOST_IMAGES = 5
"""Images that can be picked."""


@dataclass(frozen=True)
class PeopleNetwork:
    """A trained network and captures of people.

    Attributes:
        run: run folder of the network.
        people: by name.
        num_images: that it was trained to predict from.
    """

    run: Path
    people: dict[str, DataConfig]
    num_images: int
    _images: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def images_of(self, person: str) -> tuple[str, ...]:
        """Return the names of the images of a person that can be predicted from.

        Raises:
            DyngsError: the capture cannot be read.
        """
        if person not in self._images:
            views = read_capture(self.people[person]).splits["train"]
            self._images[person] = tuple(view.name for view in views)
        return self._images[person]

    def predict(self, person: str, images: tuple[str, ...] = (), up: str | None = None) -> Viewed:
        """Return a person as the network predicts it.

        Args:
            person: name.
            images: to predict from; without any, as many as in training, chosen to see much of the person.
            up: up axis; None: that of the capture.

        Raises:
            DyngsError: not a capture of a person, or unknown images.
        """
        with tempfile.TemporaryDirectory(prefix="dyngs_view_") as folder:
            out = Path(folder) / "run"
            made = predict_person(self.run, self.people[person].root, out, images or self.num_images)
            viewed = viewed_run(person, load_run(out), up)
        said = f"predicted from {', '.join(made.views)} in {made.seconds_maps + made.seconds_network:.1f} s"
        return viewed.noted(said)


def open_network(run: Path, capture: Path | None = None) -> PeopleNetwork:
    """Return a network with the people it was trained on, or those of ``capture``: one, or a folder of them.

    Raises:
        DyngsError: not the run of a network, or no captures there.
    """
    config, model = network_config(run)
    data = config.data if capture is None else config.data.model_copy(update={"root": capture.absolute()})
    if capture is not None and _is_capture(data):
        return PeopleNetwork(run, {capture.absolute().name: data}, model.source_views)
    return PeopleNetwork(run, {one.root.name: one for one in captures_in(data)}, model.source_views)


def _is_capture(data: DataConfig) -> bool:
    try:
        read_capture(data)
    except DyngsError:
        return False
    return True
