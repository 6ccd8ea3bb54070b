"""Training of the stereo network on captures of several people, and what it predicts of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ReportProgress
from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.data.capture import Capture, all_views
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import captures_in, read_capture
from dyngs.data.times import distinct_times
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.static_scene import Sides, StaticScene
from dyngs.gaussians.static_training import StaticTraining
from dyngs.human.predict.gps.rectification import (
    MAX_ANGLE,
    RectifiedPair,
    best_pair,
    cropped,
    is_inside,
    lessons,
    neighbours,
    rectified,
    well_spread,
)
from dyngs.human.predict.gps.stereo import GpsNetwork, gaussians_of, offset_loss
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    kept_open,
    load_weights,
    random_index,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU, device_for

DEPTH_FRACTION = 0.4  # of the steps in which depth alone is learned, from depth maps
DECAY = 0.9
"""Weight of the error of an iteration relative to the next."""
DEPTH_WEIGHT = 0.02  # Of the error of offsets, px, next to that of images
_AROUND = 8  # px of background around the person in the images that are compared
_FAINT = 0.02  # Opacity below which a predicted Gaussian is left out


class GpsPredictor(Predictor[GpsNetwork]):
    """Predicts the surface that pairs of neighbouring views show."""

    def __init__(
        self, config: Config, network: GpsNetwork, capture: Capture, data: DataConfig
    ) -> None:
        super().__init__(config, network, capture.splits["train"], data)
        self._capture = capture

    def chosen(self, count: int) -> list[int]:
        return best_pair(self.views) if count == 2 else well_spread(self.views, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> StaticScene:
        pairs = neighbours(self.name, self.views, views)
        loader = ImageLoader(self.views, self.data)
        images = {i: loader[i] for i in views}
        found = []
        centers = []
        for pair in pairs:
            left, right = (images[i] for i in pair)
            found.append(self._surface(left, right))
            centers.append(torch.cat([left.cameras.centers, right.cameras.centers]).mean(0))
        gaussians = Gaussians.joined(found)
        if not len(gaussians):
            raise DyngsError(
                f"{self.name}: no surface is found inside the silhouettes; is a mask or the calibration wrong?"
            )
        return StaticScene(
            gaussians=gaussians,
            sides=Sides.joined(found, centers) if len(pairs) > 1 else None,
            options=render_options(self.config.model),
            background=self.background,
        )

    def _surface(self, left: Image, right: Image) -> Gaussians:
        """Return the surface that two views show, inside both silhouettes."""
        pair = rectified(left, right, self.section.person_px)
        offsets, raw = self.network(pair)
        gaussians = gaussians_of(pair, offsets[-1], raw)
        inside = is_inside(left, gaussians.means) & is_inside(right, gaussians.means)
        return gaussians.select(inside & (gaussians.opacities >= _FAINT))

    def run_config(self, views: Sequence[int]) -> Config:
        preset = load_config(packaged_preset("static"), ["data.root=."])
        same = ("near", "eps2d", "rasterize_mode", "sh_degree")
        model = preset.model.model_copy(
            update={name: getattr(self.config.model, name) for name in same}
        )
        shown = all_views({k: x for k, x in self._capture.splits.items() if k != "pose"})
        times = distinct_times(shown).values()
        data = self.data_of_moment(self.views[views[0]].time, times)
        return preset.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.begin_with(scene, StaticTraining(FilterUpdate()))


class GpsLearner(Learner[GpsNetwork]):
    """Training of GPS-Gaussian: depth first, from depth maps, then images of the views between."""

    def __init__(
        self,
        config: Config,
        network: GpsNetwork,
        people: Sequence[DataConfig],
        device: torch.device = CPU,
    ) -> None:
        super().__init__(config, network, [person.root.name for person in people], device)
        self._opened = kept_open(_lessons, people)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        images, pairs = self._opened(person)
        pair, between = pairs[random_index(len(pairs), generator)]
        target = between[random_index(len(between), generator)]
        background = self.drawn_background(generator)
        left, right = (images[i] for i in pair)
        windows = rectified(left, right, self.section.person_px)
        windows = fields_moved_to(windows, self.device)
        only_depth = step <= round(DEPTH_FRACTION * self.config.train.steps)
        offsets, raw = self.network(windows, with_gaussians=not only_depth)
        depth_loss = offset_loss(windows, offsets, DECAY)
        if only_depth:
            found = _picture(windows, offsets[-1].detach())
            return Example(depth_loss, left, found, _picture(windows, windows.offsets))
        gaussians = gaussians_of(windows, offsets[-1], raw)
        image = cropped(images[target], _AROUND).to(self.device)
        options = replace(render_options(self.config.model), nonfinite="trust")
        drawn = StaticScene(gaussians=gaussians).render(
            image.cameras, options=options, background=background
        )
        truth = image.composite(background)
        loss = image_loss(drawn.rgb[0], drawn.alpha[0], image, truth, self.config.train)
        loss = loss + DEPTH_WEIGHT * depth_loss
        return Example(loss, image, drawn.rgb[0].detach(), truth, len(gaussians))


def _lessons(data: DataConfig) -> tuple[ImageLoader, list[tuple[tuple[int, int], list[int]]]]:
    """Return the images of a person with depth maps, and pairs of them with the views in between."""
    views = _with_silhouettes(data).splits["train"]
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
    return ImageLoader(views, data, with_maps=True), pairs


def _with_silhouettes(data: DataConfig) -> Capture:
    capture = read_capture(data)
    if not capture.has_alpha:
        raise DyngsError(
            f"{data.root}: the images have no silhouettes; give them alpha, see docs/human.md"
        )
    return capture


def _picture(pair: RectifiedPair, offsets: Tensor) -> Tensor:
    """Return (H, W, 3) offsets of the left view as a picture, grey in the middle, black outside of
    the person."""
    grey = (0.5 + offsets[0, 0] / pair.shift).nan_to_num(0.0).clamp(0, 1) * pair.solid[0, 0]
    return grey[..., None].expand(-1, -1, 3)


def learner(config: Config, generator: torch.Generator) -> GpsLearner:
    """Return the network of ``model.kind: gps`` before the first step."""
    device = device_for(config.run.device)
    return GpsLearner(config, GpsNetwork(generator).to(device), captures_in(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    say: Callable[[str], None],
    report: ReportProgress,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the capture of ``data``."""
    network = GpsNetwork(torch.Generator())
    load_weights(network, checkpoint)
    return GpsPredictor(config, network, _with_silhouettes(data), data)
