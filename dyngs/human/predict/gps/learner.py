"""Training of the stereo network on captures of several people, and what it predicts of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.data.read import read_capture
from dyngs.data.times import distinct_times
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.static_scene import Sides, StaticScene
from dyngs.gaussians.static_training import StaticTraining
from dyngs.human.predict.gps.keys import GpsModel
from dyngs.human.predict.gps.pairs import MAX_ANGLE, Pair, lessons, neighbours, well_spread
from dyngs.human.predict.gps.rectification import RectifiedPair, cropped, is_inside, rectified
from dyngs.human.predict.gps.surface import GpsNetwork, gaussians_of, offset_loss
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    load_weights,
    of_moment,
    random_index,
)
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.device import CPU, device_for, sent

DECAY = 0.9
"""Weight of the error of an iteration relative to the next."""
DEPTH_WEIGHT = 0.02  # Of the error of offsets, px, next to that of images
_AROUND = 8  # px of background around the person in the images that are compared
_FAINT = 0.02  # Opacity below which a predicted Gaussian is left out
_OPEN = 64  # People whose captures are kept open


@dataclass
class Lessons:
    """A person to train on: images with depth maps, and pairs of them with the views in between."""

    images: ImageLoader
    pairs: list[tuple[Pair, list[int]]]


@dataclass
class GpsPredictor:
    """See ``Predictor``; what is predicted is the surface that pairs of neighbouring views show."""

    config: Config
    model: GpsModel
    network: GpsNetwork
    capture: Capture
    data: DataConfig

    @property
    def name(self) -> str:
        return self.capture.root.name

    @property
    def views(self) -> tuple[View, ...]:
        return self.capture.splits["train"]

    def chosen(self, count: int) -> list[int]:
        return well_spread(self.views, count)

    def adapt(
        self,
        views: Sequence[int],
        steps: int | None = None,
        report: ReportProgress = report_nothing,
    ) -> int:
        if steps:
            raise DyngsError(
                f"--steps {steps}: gps is not trained on the images of one person; leave it out"
            )
        return 0

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> StaticScene:
        pairs = neighbours(self.name, self.views, views)
        loader = ImageLoader(self.views, self.data)
        images = {i: loader[i] for i in views}
        found = []
        centers = []
        for pair in pairs:
            both = images[pair.left], images[pair.right]
            found.append(self._seen_in(*both))
            centers.append(torch.cat([image.cameras.centers for image in both]).mean(0))
        gaussians = Gaussians.joined(found)
        background = evaluation_background(self.config.data.background, True)[1]
        if not len(gaussians):
            raise DyngsError(
                f"{self.name}: no surface is found inside the silhouettes; is a mask or the calibration wrong?"
            )
        return StaticScene(
            gaussians=gaussians,
            sides=Sides.joined(found, centers) if len(pairs) > 1 else None,
            options=render_options(self.model),
            background=background,
        )

    def _seen_in(self, left: Image, right: Image) -> Gaussians:
        """Return the surface that two views show, inside both silhouettes."""
        pair = rectified(left, right, self.model.person_px)
        gaussians = gaussians_of(pair, self.network(pair))
        inside = is_inside(left, gaussians.means) & is_inside(right, gaussians.means)
        return gaussians.select(inside & (gaussians.opacities >= _FAINT))

    def run_config(self, views: Sequence[int]) -> Config:
        preset = load_config(packaged_preset("static"), ["data.root=."])
        same = ("near", "eps2d", "rasterize_mode", "sh_degree")
        model = preset.model.model_copy(update={name: getattr(self.model, name) for name in same})
        times = distinct_times(
            all_views({k: x for k, x in self.capture.splits.items() if k != "pose"})
        )
        data = of_moment(self.data, self.views[views[0]].time, times.values())
        return preset.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.begin_with(scene, StaticTraining(FilterUpdate()))


class GpsLearner(Learner[GpsNetwork]):
    """See ``Learner``: at first only depth is learned, from depth maps, then also the images of
    views in between."""

    def __init__(
        self,
        config: Config,
        network: GpsNetwork,
        people: Sequence[DataConfig],
        device: torch.device = CPU,
    ) -> None:
        self.config, self.network, self.device = config, network, device
        self.model = _section(config)
        self._people = people
        self.lr = self.model.lr
        self.names = [person.root.name for person in people]
        chosen = config.data.background
        self.background = chosen if chosen == "random" else evaluation_background(chosen, True)[0]
        self._open: dict[int, Lessons] = {}
        self._open_person(0)  # so that captures of another kind fail at once

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        lesson = self._open_person(person)
        pair, between = lesson.pairs[random_index(len(lesson.pairs), generator)]
        target = between[random_index(len(between), generator)]
        background = sent(background_colour(self.background, generator), self.device)
        left = lesson.images[pair.left]
        right = lesson.images[pair.right]
        both = fields_moved_to(rectified(left, right, self.model.person_px), self.device)
        only_depth = step <= round(self.model.depth_fraction * self.config.train.steps)
        surface = self.network(both, with_gaussians=not only_depth)
        depth_loss = offset_loss(both, surface.offsets, DECAY)
        if only_depth:
            found, truth = (_picture(both, x) for x in (surface.offsets[-1].detach(), both.offsets))
            return Example(depth_loss, left, found, truth)
        gaussians = gaussians_of(both, surface)
        image = cropped(lesson.images[target], _AROUND).to(self.device)
        options = replace(render_options(self.model), nonfinite="trust")
        drawn = StaticScene(gaussians=gaussians).render(
            image.cameras, options=options, background=background
        )
        truth = image.composite(background)
        loss = (
            image_loss(drawn.rgb[0], drawn.alpha[0], image, truth, self.config.train)
            + DEPTH_WEIGHT * depth_loss
        )
        return Example(loss, image, drawn.rgb[0].detach(), truth, len(gaussians))

    def _open_person(self, person: int) -> Lessons:
        """Return a person's images and pairs; those of the last people are kept."""
        if person not in self._open:
            while len(self._open) >= _OPEN:
                self._open.pop(next(iter(self._open)))
            self._open[person] = _lessons(self._people[person])
        return self._open[person]


def _lessons(data: DataConfig) -> Lessons:
    views = _usable(read_capture(data), data).splits["train"]
    pairs = lessons(views)
    if not pairs:
        raise DyngsError(
            f"{data.root}: no view stands between two others that are at most {MAX_ANGLE:g} degrees apart, which a "
            "network is trained on; give a ring of 16 cameras or more"
        )
    if any(view.depth_path is None for view in views):
        raise DyngsError(
            f"{data.root}: has no depth maps, from which depth is learned; `dyngs data synth people` writes them"
        )
    return Lessons(ImageLoader(views, data, with_maps=True), pairs)


def _usable(capture: Capture, data: DataConfig) -> Capture:
    """Return ``capture``. Raises DyngsError: it has no silhouettes."""
    if not capture.has_alpha:
        raise DyngsError(
            f"{data.root}: the images have no silhouettes; give them alpha, see docs/human.md"
        )
    return capture


def _picture(pair: RectifiedPair, offsets: Tensor | None) -> Tensor:
    """Return (H, W, 3) offsets of the left view as a picture, grey in the middle, black outside of
    the person."""
    assert offsets is not None
    grey = (0.5 + offsets[0, 0] / pair.shift).nan_to_num(0.0).clamp(0, 1) * pair.solid[0, 0]
    return grey[..., None].expand(-1, -1, 3)


def learner(config: Config, generator: torch.Generator) -> GpsLearner:
    """Return the network of ``model.kind: gps`` before the first step."""
    device = device_for(config.run.device)
    network = GpsNetwork(_section(config), generator).to(device)
    return GpsLearner(config, network, captures_in(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    say: Callable[[str], None],
    report: ReportProgress,
) -> Predictor:
    """Return the network of ``checkpoint`` with the capture of ``data``."""
    network = GpsNetwork(_section(config), torch.Generator())
    load_weights(network, checkpoint)
    return GpsPredictor(config, _section(config), network, _usable(read_capture(data), data), data)


def _section(config: Config) -> GpsModel:
    if not isinstance(config.model, GpsModel):
        raise TypeError(f"not a stereo network: {config.model!r}")
    return config.model
