"""Learned stereo: Gaussians of the pixels of a rectified pair, training and prediction.

After GPS-Gaussian (Zheng et al. 2024), with the disparities of ``matching``.

Symbols: two views, left and right; crops of H x W pixels, h x w a quarter of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import SH_C0, ProgressCallback
from dyngs.core.errors import DyngsError
from dyngs.core.state import move_fields_to
from dyngs.data.capture import Capture, all_views
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.static_scene import StaticScene, ViewSides
from dyngs.gaussians.static_training import StaticTraining
from dyngs.human.predict.gps.matching import CostVolumeNetwork, RecurrentNetwork, residual_layer
from dyngs.human.predict.gps.rectification import (
    MAX_ANGLE,
    RectifiedPair,
    best_pair,
    is_inside,
    neighbour_pairs,
    rectify_views,
    spread_around_person,
    training_pairs,
)
from dyngs.human.predict.people import crop_to_person
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    CaptureLearner,
    Encoder,
    Example,
    Predictor,
    image_loss,
    initialize_weights,
    load_weights,
    random_item,
    upsample,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.quaternions import quat_product, quats_from_matrices, unit_quats

WIDTHS = (24, 40, 64)
"""Channels of image features at 1/4, 1/8 and 1/16 of the resolution."""
HEADS = {"rotation": 4, "scale": 3, "opacity": 1}
"""Output channels per pixel."""
LARGEST = 4.0
"""Largest standard deviation, in pixels at the depth of the pixel."""
_SCALE_LOGIT = -1.95  # initial scale: half a pixel
_OPACITY_LOGIT = 4.0  # initial opacity: nearly opaque
_DEPTH_WIDTHS = (16, 24, 32)  # channels of depth features
_LAST = 32  # channels of the last layer
_RANGE = 64.0  # normalisation of offsets as network inputs, px
_MIN_DISPARITY = 0.2  # relative to that of the person's middle


class GpsNetwork(nn.Module):
    """Network that predicts depth and Gaussians of a rectified pair; both tasks share image
    features.

    It works at half the resolution of the crops, with pixels (un)shuffled in blocks of four.
    """

    def __init__(self, generator: torch.Generator, section: Any) -> None:
        """Create the network of a ``GpsModel`` on the CPU with weights from ``generator``."""
        super().__init__()
        half, quarter, _ = WIDTHS
        with torch.device("cpu"):
            self.encoder = Encoder(16, WIDTHS)
            self.stereo = (
                RecurrentNetwork(WIDTHS, section.channels, section.updates)
                if section.matching == "recurrent"
                else CostVolumeNetwork(WIDTHS)
            )
            self.depth_encoder = Encoder(8, _DEPTH_WIDTHS)
            below = quarter + _DEPTH_WIDTHS[1] + _DEPTH_WIDTHS[2]
            self.up = nn.ModuleList(
                [residual_layer(below, half), residual_layer(2 * half + _DEPTH_WIDTHS[0], half)]
            )
            self.last = nn.Sequential(nn.Conv2d(half + 20, _LAST, 3, padding=1), nn.SiLU())
            self.heads = nn.Conv2d(_LAST, 4 * sum(HEADS.values()), 1)
        initialize_weights(self, generator)
        for layer in (self.heads, self.stereo.change, self.stereo.weights):
            nn.init.zeros_(layer.weight)

    def forward(
        self, pair: RectifiedPair, *, with_gaussians: bool = True
    ) -> tuple[list[Tensor], Tensor | None]:
        """Return offsets (2, 1, H, W), px, from coarse to fine, and raw Gaussian values (2, 8, H,
        W).

        The values are in the order of ``HEADS``.
        """
        inside = pair.solid.float()
        images = pixel_unshuffle(torch.cat([(2 * pair.rgb - 1) * inside, pair.alpha], dim=1), 2)
        levels = self.encoder(images)
        offsets, fused = self.stereo(pair, levels)
        if not with_gaussians:
            return offsets, None
        depth = pixel_unshuffle(torch.cat([offsets[-1] / _RANGE * inside, inside], dim=1), 2)
        halves, quarters, eighths = self.depth_encoder(depth)
        features = self.up[0](torch.cat([fused, quarters, upsample(eighths)], dim=1))
        features = self.up[1](torch.cat([upsample(features), levels[0], halves], dim=1))
        features = self.last(torch.cat([upsample(features), images, depth[:, :4]], dim=1))
        return offsets, pixel_shuffle(self.heads(features), 2)


def surface_gaussians_of_pair(pair: RectifiedPair, offsets: Tensor, raw: Tensor) -> Gaussians:
    """Return the Gaussians of the person's pixels in both views; differentiable in offsets and raw
    values.

    Means lie on the pixel rays, rotations are relative to the axes of the crops, colours are those
    of the images. Opacities are multiplied by the alpha of the pixel and of its match in the other
    view (visual hull).

    Args:
        pair: rectified views.
        offsets: (2, 1, H, W) px.
        raw: (2, 8, H, W) outputs of the network.
    """
    offsets = torch.maximum(offsets, (_MIN_DISPARITY - 1) * pair.shift)
    depth = pair.depth(offsets)
    solid = pair.solid[:, 0]
    parts = raw.permute(0, 2, 3, 1)[solid].split(tuple(HEADS.values()), dim=1)
    part = dict(zip(HEADS, parts, strict=True))
    pixel = (depth[:, 0][solid] / pair.focal)[:, None]
    scales = LARGEST * pixel * (part["scale"] + _SCALE_LOGIT).sigmoid()
    within = (pair.alpha * pair.in_other_view(pair.alpha, offsets))[solid[:, None]]
    opacities = (part["opacity"][:, 0] + _OPACITY_LOGIT).sigmoid() * within
    one = part["rotation"].new_tensor([1.0, 0.0, 0.0, 0.0])
    world_from_rect = quats_from_matrices(pair.rect_from_world.T[None])
    rgb = pair.rgb.permute(0, 2, 3, 1)[solid]
    return Gaussians(
        means=pair.points(depth)[solid],
        quats=quat_product(world_from_rect.expand(len(rgb), 4), unit_quats(one + part["rotation"])),
        log_scales=scales.clamp_min(1e-12).log(),
        logit_opacities=opacities.logit(eps=1e-4),
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )


def end_point_error(pair: RectifiedPair, offsets: Tensor) -> Tensor:
    """Return the mean error of ``offsets`` (2, 1, H, W) where the truth is known, px."""
    known = pair.solid & pair.offsets.isfinite()
    return (offsets[known] - pair.offsets[known]).abs().mean()


def offset_loss(pair: RectifiedPair, offsets: Sequence[Tensor], decay: float) -> Tensor:
    """Return the weighted sum of the end-point errors of all ``offsets``, px.

    The last offsets have weight 1, each earlier one ``decay`` times the next (Teed and Deng 2020).
    """
    total = torch.zeros((), device=pair.rgb.device)
    for i, found in enumerate(reversed(offsets)):
        total = total + decay**i * end_point_error(pair, found)
    return total


def consistency_loss(pair: RectifiedPair, offsets: Tensor) -> Tensor:
    """Return by how much pixels lie in front of the surface that the other view sees there, px.

    The mean over all pixels of the person whose match lies inside the other silhouette. A pixel
    behind that surface may be hidden from the other view and does not count.
    """
    matches = offsets.detach()
    other = pair.in_other_view(offsets, matches)
    known = pair.solid & (pair.in_other_view(pair.solid.float(), matches) > _INSIDE)
    return ((offsets - other).relu() * known).sum() / known.sum().clamp_min(1)


DECAY = 0.9
"""Weight of an iteration's offset error relative to the next."""
_DECAY_POWER = 15  # weight of the first of all updates: DECAY to this power (Lipson et al. 2021)
_INSIDE = 0.999  # share of the person at a match without background, up to rounding
DEPTH_WEIGHT = 0.02  # of the offset error, px, next to the image loss
_AROUND = 8  # background around the person in target images, px
_MIN_OPACITY = 0.02  # of predicted Gaussians
# Images of a person with depth maps, and training pairs, see ``training_pairs``.
_Opened = tuple[ImageLoader, list[tuple[tuple[int, int], list[int]]]]


class GpsPredictor(Predictor[GpsNetwork]):
    """Predicts the surface seen by pairs of neighbouring views."""

    def __init__(
        self, config: Config, network: GpsNetwork, capture: Capture, data: DataConfig
    ) -> None:
        super().__init__(config, network, capture.splits["train"], data)
        self._capture = capture

    def chosen(self, count: int) -> list[int]:
        return best_pair(self.views) if count == 2 else spread_around_person(self.views, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> StaticScene:
        pairs = neighbour_pairs(self.name, self.views, views)
        images = ImageLoader(self.views, self.data)
        surfaces = []
        centers = []
        for pair in pairs:
            left, right = (images[i] for i in pair)
            surfaces.append(self._surface(left, right))
            centers.append(torch.cat([left.cameras.centers, right.cameras.centers]).mean(0))
        gaussians = Gaussians.joined(surfaces)
        if not len(gaussians):
            raise DyngsError(
                f"{self.name}: no surface inside the silhouettes; check the masks and the "
                "calibration"
            )
        return StaticScene(
            gaussians=gaussians,
            sides=ViewSides.joined(surfaces, centers) if len(pairs) > 1 else None,
            options=render_options(self.config.model),
            background=self.background,
        )

    def _surface(self, left: Image, right: Image) -> Gaussians:
        """Return the surface of a pair, limited to both silhouettes."""
        pair = rectify_views(left, right, self.section.person_px)
        offsets, raw = self.network(pair)
        gaussians = surface_gaussians_of_pair(pair, offsets[-1], raw)
        inside = is_inside(left, gaussians.means) & is_inside(right, gaussians.means)
        return gaussians.select(inside & (gaussians.opacities >= _MIN_OPACITY))

    def run_config(self, views: Sequence[int]) -> Config:
        preset = load_config(packaged_preset("static"), ["data.root=."])
        shared_keys = {"near", "eps2d", "rasterize_mode", "sh_degree"}
        model = preset.model.model_copy(update=self.section.model_dump(include=shared_keys))
        filmed = all_views({k: x for k, x in self._capture.splits.items() if k != "pose"})
        data = self.data_at_time(self.views[views[0]].time, filmed)
        return preset.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.start_from(scene, StaticTraining(FilterUpdate()))


class GpsLearner(CaptureLearner[GpsNetwork, _Opened]):
    """Trains on depth maps first, then also on images of views between those of a pair."""

    def open_person(self, data: DataConfig) -> _Opened:
        views = _with_silhouettes(data).splits["train"]
        pairs = training_pairs(views)
        if not pairs:
            raise DyngsError(
                f"{data.root}: no view lies between two others at most {MAX_ANGLE:g} degrees "
                "apart, as training needs; use a ring of 16 or more cameras"
            )
        if any(view.depth_path is None for view in views):
            raise DyngsError(
                f"{data.root}: no depth maps, which training needs; `dyngs data synth people` "
                "writes them"
            )
        return ImageLoader(views, data, with_maps=True), pairs

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        images, pairs = self.opened(person)
        pair, between = random_item(pairs, generator)
        target = random_item(between, generator)
        background = self.sample_background(generator)
        left, right = (images[i] for i in pair)
        rectified = rectify_views(left, right, self.section.person_px)
        rectified = move_fields_to(rectified, self.device)
        only_depth = step <= round(self.section.depth_fraction * self.config.train.steps)
        offsets, raw = self.network(rectified, with_gaussians=not only_depth)
        depth_loss = self._depth_loss(rectified, offsets)
        last = offsets[-1].detach()
        scores = {"end_point_error_px": float(end_point_error(rectified, last))}
        if only_depth:
            predicted = _offset_image(rectified, last)
            truth = _offset_image(rectified, rectified.offsets)
            return Example(depth_loss, left, predicted, truth, scores=scores)
        gaussians = surface_gaussians_of_pair(rectified, offsets[-1], raw)
        image = crop_to_person(images[target], _AROUND).to(self.device)
        options = replace(render_options(self.config.model), nonfinite="trust")
        render = StaticScene(gaussians=gaussians).render(
            image.cameras, options=options, background=background
        )
        truth = image.composite(background)
        loss = image_loss(render.rgb[0], render.alpha[0], image, truth, self.config.train)
        loss = loss + DEPTH_WEIGHT * depth_loss
        return Example(loss, image, render.rgb[0].detach(), truth, len(gaussians), scores)

    def _depth_loss(self, pair: RectifiedPair, offsets: Sequence[Tensor]) -> Tensor:
        """Return the loss of all ``offsets``, px."""
        if self.section.matching == "cost_volume":
            return offset_loss(pair, offsets, DECAY)
        decay = DECAY ** (_DECAY_POWER / max(len(offsets) - 1, 1))
        consistency = self.section.consistency_weight * consistency_loss(pair, offsets[-1])
        return offset_loss(pair, offsets, decay) + consistency


def _with_silhouettes(data: DataConfig) -> Capture:
    capture = read_capture(data)
    if not capture.has_alpha:
        raise DyngsError(
            f"{data.root}: no silhouettes; add alpha or masks, see `dyngs docs people`"
        )
    return capture


def _offset_image(pair: RectifiedPair, offsets: Tensor) -> Tensor:
    """Visualise the offsets of the left view as grey levels (H, W, 3), black outside the person."""
    grey = (0.5 + offsets[0, 0] / pair.shift).nan_to_num(0.0).clamp(0, 1) * pair.solid[0, 0]
    return grey[..., None].expand(-1, -1, 3)


def learner(config: Config, generator: torch.Generator) -> GpsLearner:
    """Return the network in training, before the first step."""
    return GpsLearner(config, GpsNetwork(generator, config.model))


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    log: Callable[[str], None],
    on_progress: ProgressCallback,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the capture of ``data``."""
    network = GpsNetwork(torch.Generator(), config.model)
    load_weights(network, checkpoint)
    return GpsPredictor(config, network, _with_silhouettes(data), data)
