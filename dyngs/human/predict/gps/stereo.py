"""Learned stereo: disparity and Gaussians of the pixels of a rectified pair, training, prediction.

After GPS-Gaussian (Zheng et al. 2024), with one of two networks for the disparity.
``CostVolumeNetwork`` corrects the costs of candidate offsets once: colour differences (plane sweep,
Collins 1996) and whether the other view shows the background (visual hull). Untrained it equals
block matching. ``RecurrentNetwork`` correlates learned features and updates the offsets repeatedly,
as in GPS-Gaussian, which follows RAFT-Stereo (Lipson et al. 2021).

Symbols: two views, left and right; crops of H x W pixels, h x w a quarter of it; C channels, D
offsets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import (
    avg_pool2d,
    instance_norm,
    interpolate,
    max_pool2d,
    pad,
    pixel_shuffle,
    pixel_unshuffle,
    unfold,
)

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
from dyngs.human.predict.gps.rectification import (
    MAX_ANGLE,
    SIDES,
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
    GROUPS,
    CaptureLearner,
    Encoder,
    Example,
    Predictor,
    ResidualBlock,
    image_loss,
    initialize_weights,
    load_weights,
    random_item,
    upsample,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.quaternions import quat_product, quats_from_matrices, unit_quats

QUARTER = 4
"""Pixels of the crops per pixel of the plane sweep, per axis."""
NUM_OFFSETS = 48
"""Candidate offsets, evenly spaced in ``RANGE``."""
RANGE = (-0.22, 0.28)
"""Range of offsets, relative to the disparity of the person's middle: 0.56 m behind to 0.44 m in
front of it at a distance of 2 m."""
_COLOUR, _BESIDE = 300.0, 5.0  # factors of colour difference and background in the offset logits
_SHARPNESS = 2.0  # of upsampling weights, which fall with the squared distance
_NEVER = -1e4  # logit of excluded values


class CostVolumeNetwork(nn.Module):
    """UNet that predicts the offsets of two views from plane-sweep costs and image features."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.enter = residual_layer(2 * NUM_OFFSETS + fine, fine)
        self.down = nn.ModuleList(
            [residual_layer(fine + middle, middle, 2), residual_layer(middle + coarse, coarse, 2)]
        )
        self.deep = ResidualBlock(coarse)
        self.up = nn.ModuleList(
            [residual_layer(coarse + middle, middle), residual_layer(middle + fine, fine)]
        )
        self.change = _convolution(fine, NUM_OFFSETS + 1)
        self.weights = _convolution(fine, 9 * QUARTER**2)

    def forward(self, pair: RectifiedPair, levels: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, bilinearly upsampled and refined, and features (2, C, h
        / 2, w / 2).

        ``levels`` are image features at 1/4, 1/8 and 1/16 of the resolution.
        """
        offsets = candidate_offsets(pair.shift)
        swept = plane_sweep_costs(pair.rgb, pair.alpha, offsets)
        fine = self.enter(torch.cat([levels[0], 5 * swept], dim=1))
        middle = self.down[0](torch.cat([fine, upsample(levels[1])], dim=1))
        coarse = self.deep(self.down[1](torch.cat([middle, upsample(levels[2])], dim=1)))
        middle = self.up[0](torch.cat([middle, upsample(coarse)], dim=1))
        fine = self.up[1](torch.cat([fine, upsample(middle)], dim=1))
        change = self.change(fine)
        colours, beside = swept.split(NUM_OFFSETS, dim=1)
        probabilities = (change[:, 1:] - _COLOUR * colours - _BESIDE * beside).softmax(dim=1)
        expected = (probabilities * probabilities.new_tensor(offsets)[:, None, None]).sum(
            1, keepdim=True
        ) + change[:, :1]
        upsampled_offsets = interpolate(expected, scale_factor=QUARTER, mode="bilinear")
        return [
            upsampled_offsets,
            convex_upsample(expected, self.weights(fine), max_pool2d(pair.solid.float(), QUARTER)),
        ], middle


def residual_layer(before: int, width: int, stride: int = 1) -> nn.Module:
    """Return a convolution from ``before`` to ``width`` channels and a residual block."""
    return nn.Sequential(nn.Conv2d(before, width, 3, stride, padding=1), ResidualBlock(width))


def _convolution(before: int, width: int, size: int = 3) -> nn.Conv2d:
    return nn.Conv2d(before, width, size, padding=size // 2)


def candidate_offsets(shift: Tensor) -> list[int]:
    """Return D candidate offsets, even px, for the disparity ``shift`` of the person's middle."""
    halves = shift / 2 * torch.linspace(*RANGE, NUM_OFFSETS, device=shift.device)
    return (2 * halves.round()).int().tolist()


def plane_sweep_costs(rgb: Tensor, alpha: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return costs (2, 2 D, h, w): per offset the colour difference, and the background of the
    other view.

    Computed at half the resolution of ``rgb`` (2, 3, H, W) and ``alpha`` (2, 1, H, W), and
    averaged over 3 x 3 and 2 x 2 pixels.
    """
    layers = avg_pool2d(torch.cat([rgb * alpha, alpha], dim=1), 2)
    width = layers.shape[3]
    padding = min(max(abs(x) // 2 for x in offsets), width)
    padded = pad(layers.flip(0), (padding, padding))
    colours = []
    beside = []
    for offset in offsets:
        step = max(-padding, min(padding, offset // 2))
        right = padded[0].narrow(2, padding - step, width)
        left = padded[1].narrow(2, padding + step, width)
        other = torch.stack([right, left])
        colours.append((other[:, :3] - layers[:, :3]).abs().mean(1))
        beside.append(1 - other[:, 3])
    volume = torch.stack([*colours, *beside], dim=1)
    return avg_pool2d(avg_pool2d(volume, 3, 1, 1, count_include_pad=False), 2)


def convex_upsample(coarse: Tensor, weights: Tensor, inside: Tensor) -> Tensor:
    """Upsample ``coarse`` (B, 1, h, w) to (B, 1, 4 h, 4 w) by convex combination (Teed and Deng
    2020).

    ``weights`` (B, 9 * 16, h, w) are logits of the 3 x 3 neighbours for each of the 16 pixels,
    added to those of a Gaussian. Neighbours where ``inside`` (B, 1, h, w) is 0 are excluded.
    """
    batch, _, height, width = coarse.shape
    values, known = (
        unfold(pad(x, (1, 1, 1, 1), mode=mode), 3).view(batch, 9, 1, 1, height, width)
        for x, mode in ((coarse, "replicate"), (inside, "constant"))
    )
    logits = weights.view(batch, 9, QUARTER, QUARTER, height, width) + _gaussian_logits(coarse)
    shares = torch.where(known > 0, logits, _NEVER).softmax(dim=1)
    fine = (shares * values).sum(1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, QUARTER * height, QUARTER * width)


def _gaussian_logits(like: Tensor) -> Tensor:
    """Return Gaussian logits (9, 4, 4, 1, 1) of 3 x 3 neighbours for each of 4 x 4 pixels."""
    pixels = (torch.arange(QUARTER, device=like.device) + 0.5) / QUARTER - 0.5
    square = (torch.arange(-1, 2, device=like.device)[:, None] - pixels).square()
    distances = square[:, None, :, None] + square[:, None]
    return -_SHARPNESS * distances.view(9, QUARTER, QUARTER, 1, 1)


LEVELS = 4
"""Levels of the correlation pyramid; columns are halved from each to the next."""
RADIUS = 4
"""Radius of the look-up, columns of each level."""
_WEIGHT_SCALE = 0.25  # of upsampling logits, against their large gradients (Teed and Deng 2020)


class RecurrentNetwork(nn.Module):
    """Network that updates the offsets of both views by a convolutional GRU.

    The views share all weights. Each update looks up correlations around the current matches. The
    published network works at 1/8 of images of 1024 px; this one at a quarter of smaller crops.

    Args:
        widths: channels of the image features at 1/4, 1/8 and 1/16 of the resolution.
        width: channels C of matching features and hidden state, a multiple of 24; 96 as published.
        updates: number of updates, 3 as published.
    """

    def __init__(self, widths: Sequence[int], width: int, updates: int) -> None:
        super().__init__()
        part = 2 * width // 3
        wide = 8 * width // 3
        joined = width + 2 * part
        self.updates = updates
        self.enter = residual_layer(sum(widths), width)
        self.split = nn.Sequential(
            nn.GroupNorm(GROUPS, width), nn.SiLU(), _convolution(width, 3 * width)
        )
        self.gate_bias = _convolution(width, 2 * width)
        self.candidate_bias = _convolution(width, width)
        self.correlation = _layers((LEVELS * (2 * RADIUS + 1), part, 1), (part, part))
        self.position = _layers((1, part, 7), (part, part))
        # The last channel of the motion features is the offset itself.
        self.motion = _layers((2 * part, 2 * part - 1))
        self.gates = _convolution(joined, 2 * width)
        self.candidate = _convolution(joined, width)
        self.leave = _layers((width, 2 * wide))
        self.change = _convolution(wide, 1)
        self.weights = _convolution(wide, 9 * QUARTER**2, 1)

    def forward(self, pair: RectifiedPair, levels: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, after each update, and features (2, C, h / 2, w / 2).

        ``levels`` are image features at 1/4, 1/8 and 1/16 of the resolution.
        """
        fine, middle, coarse = levels
        coarse = upsample(upsample(coarse))
        features = self.enter(torch.cat([fine, upsample(middle), coarse], dim=1))
        matching, hidden, context = self.split(features).chunk(3, dim=1)
        hidden = hidden.tanh()
        gate_bias = self.gate_bias(context.relu())
        candidate_bias = self.candidate_bias(context.relu())
        # Correlations of features without a common mean are largest at the match from the start.
        pyramid = correlation_pyramid(instance_norm(matching))
        inside = max_pool2d(pair.solid.float(), QUARTER)
        offsets = torch.zeros_like(inside)  # quarter pixels
        found = []
        for _ in range(self.updates):
            offsets = offsets.detach()
            seen = [self.correlation(look_up(pyramid, offsets)), self.position(offsets)]
            motion = torch.cat([self.motion(torch.cat(seen, dim=1)), offsets], dim=1)
            gates = self.gates(torch.cat([hidden, motion], dim=1)) + gate_bias
            update, reset = gates.sigmoid().chunk(2, dim=1)
            candidate = self.candidate(torch.cat([reset * hidden, motion], dim=1))
            hidden = torch.lerp(hidden, (candidate + candidate_bias).tanh(), update)
            to_change, to_weights = self.leave(hidden).chunk(2, dim=1)
            offsets = offsets + self.change(to_change)
            weights = _WEIGHT_SCALE * self.weights(to_weights)
            found.append(convex_upsample(QUARTER * offsets, weights, inside))
        return found, middle


def _layers(*shapes: tuple[int, ...]) -> nn.Module:
    """Return convolutions of the given input channels, output channels and size, with ReLU."""
    return nn.Sequential(*(nn.Sequential(_convolution(*shape), nn.ReLU()) for shape in shapes))


def correlation_pyramid(features: Tensor) -> list[Tensor]:
    """Return scaled dot products of features (2, C, h, w) of two views along their rows.

    Each of the ``LEVELS`` levels is (2, h, w, columns): the first pairs every pixel of a view with
    all w columns of the other one, the next ones with means of 2, 4 and 8 columns.
    """
    scaled = features / math.sqrt(features.shape[1])
    others = features.flip(0)
    levels = []
    for _ in range(LEVELS):
        levels.append(torch.einsum("vchx,vchy->vhxy", scaled, others))
        # Products with mean features are mean products. An odd last column is kept.
        others = avg_pool2d(others, (1, 2), ceil_mode=True)
    return levels


def look_up(pyramid: Sequence[Tensor], offsets: Tensor) -> Tensor:
    """Return correlations (2, LEVELS (2 RADIUS + 1), h, w) around the matches of ``offsets``.

    Linear between columns, 0 outside; in the order of increasing offset in both views.

    Args:
        pyramid: levels of ``correlation_pyramid``.
        offsets: (2, 1, h, w), columns.
    """
    sides = offsets.new_tensor(SIDES)[:, None, None, None]
    columns = torch.arange(offsets.shape[3], device=offsets.device)[:, None] + 0.5
    matches = columns - sides * offsets.permute(0, 2, 3, 1)
    steps = sides * torch.arange(-RADIUS, RADIUS + 1, device=offsets.device)
    found = []
    for level, products in enumerate(pyramid):
        places = matches / 2**level - 0.5 - steps
        first = places.floor()
        padded = pad(products, (1, 1))
        left, right = (
            padded.gather(3, (first + k).clamp(0, padded.shape[3] - 1).long()) for k in (1, 2)
        )
        found.append(torch.lerp(left, right, places - first))
    return torch.cat(found, dim=3).permute(0, 3, 1, 2)


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
_OFFSET_UNIT = 64.0  # normalisation of offsets as network inputs, px
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
        depth = pixel_unshuffle(torch.cat([offsets[-1] / _OFFSET_UNIT * inside, inside], dim=1), 2)
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
        self,
        config: Config,
        checkpoint: Checkpoint,
        data: DataConfig,
        log: Callable[[str], None],
        on_progress: ProgressCallback,
    ) -> None:
        """Load the network of ``checkpoint`` and the capture of ``data``."""
        network = GpsNetwork(torch.Generator(), config.model)
        load_weights(network, checkpoint)
        self._capture = _with_silhouettes(data)
        super().__init__(config, network, self._capture.splits["train"], data)

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


predictor = GpsPredictor
