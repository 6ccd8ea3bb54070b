"""Training of a network of people on the images of one person, before that person is predicted from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.config import Config, HumanPredictorModel
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.schedule import Rates
from dyngs.human.prediction.network import AtlasNetwork, predict_gaussians
from dyngs.models.views import evaluation_background
from dyngs.training.prediction import MAX_GRADIENT, Filmed, human_options, image_loss, scene_of

_RATE = 1e-4
"""Highest learning rate of Adam per image, which falls linearly: a single one says little about the other sides."""


def adapt_network(
    network: AtlasNetwork,
    person: Filmed,
    views: Sequence[int],
    mean: Tensor,
    config: Config,
    model: HumanPredictorModel,
    steps: int,
    report: ReportProgress = report_nothing,
) -> None:
    """Train ``network`` in place until its prediction shows the images better that it is predicted from.

    Args:
        network: trained on other people.
        person: with images.
        views: predicted from, and compared with.
        mean: (3, S, S) colours of the training people.
        config: of the network's run.
        model: its section.
        steps: 0 changes nothing.
        report: is told how far it has come.
    """
    options = replace(render_options(model), nonfinite="trust")
    background = evaluation_background(config.data.background, True)[1]
    images, maps = [person.images[i] for i in views], person.look(list(views))
    rate, human = _RATE * len(views), human_options(model)
    optimizer = torch.optim.Adam(network.parameters(), lr=rate)
    for step in range(steps):
        avatar = predict_gaussians(person.sitter, maps, mean, network, model.min_silhouette_fraction)
        scene = scene_of(human, avatar, Rates(1))[0]
        total = torch.zeros((), device=mean.device)
        for image in images:
            moment = scene.time_step(image.time)
            rendering = scene.render(image.cameras, moment, options=options, background=background)
            total = total + image_loss(rendering, image, image.composite(background), config) / len(images)
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        if not bool(torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT).isfinite()):
            break
        for group in optimizer.param_groups:
            group["lr"] = rate * (1.0 - step / steps)
        optimizer.step()
        report("training on the images", step + 1, steps)
