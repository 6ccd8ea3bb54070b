"""Training of a network on the images of one person: it shows them better; no step changes nothing."""

from __future__ import annotations

from pathlib import Path

import torch
from tiny_people import NET, people, person

from dyngs.config import Config
from dyngs.gaussians.schedule import Rates
from dyngs.human.prediction.network import predict_gaussians
from dyngs.training.adaptation import adapt_network
from dyngs.training.prediction import Filmed, human_options, new_network, scene_of

STEPS = 12


def test_it_shows_the_images_better(tmp_path: Path) -> None:
    """The error of the images falls, by the same every time; no step changes nothing."""
    shown = person(people(tmp_path, (1,)) / "p1")
    first, trained, again = (error_after(shown, steps) for steps in (0, STEPS, STEPS))
    assert trained < first
    assert trained == again


def error_after(shown: Filmed, steps: int) -> float:
    """Sum over three views of the mean absolute error on white, of a network trained on these for ``steps``."""
    values = {"data": {"root": "."}, "model": NET, "train": {"alpha_weight": 0.1}}
    network, mean, views = new_network(NET, torch.Generator().manual_seed(0)), torch.full((3, 32, 32), 0.5), [0, 3, 6]
    before = {name: x.clone() for name, x in network.state_dict().items()}
    adapt_network(network, shown, views, mean, Config.model_validate(values), NET, steps)
    unchanged = all(torch.equal(x, before[name]) for name, x in network.state_dict().items())
    assert unchanged == (steps == 0)
    with torch.no_grad():
        avatar = predict_gaussians(shown.sitter, shown.look(views), mean, network, NET.min_silhouette_fraction)
        scene, white = scene_of(human_options(NET), avatar, Rates(1))[0], torch.ones(3)
        return sum(
            (scene.render(image.cameras, scene.time_step(image.time), background=white).rgb[0] - image.composite(white))
            .abs()
            .mean()
            .item()
            for image in (shown.images[view] for view in views)
        )
