"""The depth of every pixel of two rectified views: a sweep over offsets, of which a network finds
the right one.

GPS-Gaussian (Zheng et al. 2024) correlates learned features and refines a match step by step. Here
what speaks for an offset is computed: how much colours would differ (plane sweep, Collins 1996),
and whether the other view shows the person there at all (visual hull). The network corrects that,
and is as good as block matching before it is trained.

Local letters: two views, left and right; H x W pixels of the windows, h x w of a quarter of them; C
channels, D offsets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import (
    avg_pool2d,
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
from dyngs.data.read import list_captures, read_capture
from dyngs.data.times import distinct_times
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.static_scene import StaticScene, ViewSides
from dyngs.gaussians.static_training import StaticTraining
from dyngs.human.predict.gps.rectification import (
    MAX_ANGLE,
    RectifiedPair,
    best_pair,
    crop_to_person,
    is_inside,
    neighbours,
    rectify_views,
    spread_around_person,
    training_pairs,
)
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    Encoder,
    Example,
    Learner,
    Predictor,
    ResidualBlock,
    image_loss,
    initialize_weights,
    keep_captures_open,
    load_weights,
    random_index,
    upsample,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU, select_device
from dyngs.ops.quaternions import quat_product, quats_from_matrices, unit_quats

QUARTER = 4
"""Pixels of the windows per pixel of the sweep."""
NUM_OFFSETS = 48
"""Offsets that are looked at, evenly between those of ``RANGE``."""
RANGE = (-0.22, 0.28)
"""Least and largest offset, relative to the disparity of the middle: 0.56 m behind to 0.44 m before
it at 2 m."""
# What the logit of an offset loses by the difference of colours, and beside the person
_COLOUR, _BESIDE = 300.0, 5.0
_SHARPNESS = 2.0
_NEVER = -1e4  # Logits of upsampling: by squared distance, and of what cannot be
SIDES = (1.0, -1.0)
"""A larger offset lies further left in the right view, further right in the left one."""


class StereoNetwork(nn.Module):
    """Offsets of two views, see ``dyngs.human.predict.gps.rectification``, from a sweep and the features of the
    images: a UNet."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.enter = _block(2 * NUM_OFFSETS + fine, fine)
        self.down = nn.ModuleList(
            [_block(fine + middle, middle, 2), _block(middle + coarse, coarse, 2)]
        )
        self.deep = ResidualBlock(coarse)
        self.up = nn.ModuleList([_block(coarse + middle, middle), _block(middle + fine, fine)])
        self.change = nn.Conv2d(fine, NUM_OFFSETS + 1, 3, padding=1)
        self.weights = nn.Conv2d(fine, 9 * QUARTER**2, 3, padding=1)

    def forward(
        self, levels: Sequence[Tensor], swept: Tensor, offsets: Sequence[int], inside: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Return offsets (2, 1, H, W), px, and features (2, C, h / 2, w / 2).

        The offsets are those of a quarter of the resolution, then fine ones. ``levels`` are
        features of the images at 1/4, 1/8 and 1/16, ``swept`` is what ``sweep`` says of ``offsets``
        (D), ``inside`` (2, 1, H, W) is 1 where the person is.
        """
        fine = self.enter(torch.cat([levels[0], 5 * swept], dim=1))
        middle = self.down[0](torch.cat([fine, upsample(levels[1])], dim=1))
        coarse = self.deep(self.down[1](torch.cat([middle, upsample(levels[2])], dim=1)))
        middle = self.up[0](torch.cat([middle, upsample(coarse)], dim=1))
        fine = self.up[1](torch.cat([fine, upsample(middle)], dim=1))
        change = self.change(fine)
        colours, beside = swept.split(NUM_OFFSETS, dim=1)
        shares = (change[:, 1:] - _COLOUR * colours - _BESIDE * beside).softmax(dim=1)
        found = (shares * shares.new_tensor(offsets)[:, None, None]).sum(1, keepdim=True) + change[
            :, :1
        ]
        enlarged = interpolate(found, scale_factor=QUARTER, mode="bilinear")
        return [enlarged, refined(found, self.weights(fine), max_pool2d(inside, QUARTER))], middle


def _block(before: int, width: int, stride: int = 1) -> nn.Module:
    return nn.Sequential(nn.Conv2d(before, width, 3, stride, padding=1), ResidualBlock(width))


def offsets_of(shift: Tensor) -> list[int]:
    """Return the offsets (D) that are looked at for the disparity ``shift`` of the middle of the
    person, even px."""
    return [
        2 * round(float(x))
        for x in (shift / 2) * torch.linspace(*RANGE, NUM_OFFSETS, device=shift.device)
    ]


def plane_sweep_costs(rgb: Tensor, alpha: Tensor, offsets: Sequence[int]) -> Tensor:
    """Return (2, 2 D, h, w): per offset the difference of colours, and how much of the other view
    there is background.

    Of ``rgb`` (2, 3, H, W) and ``alpha`` (2, 1, H, W) at half the resolution, means over 3 x 3 and
    2 x 2 of its pixels.
    """
    layers = avg_pool2d(torch.cat([rgb * alpha, alpha], dim=1), 2)
    width = layers.shape[3]
    room = min(max(abs(x) // 2 for x in offsets), width)
    around = pad(layers.flip(0), (room, room))
    colours = []
    beside = []
    for offset in offsets:
        starts = (room - int(side) * max(-room, min(room, offset // 2)) for side in SIDES)
        other = torch.stack(
            [view[..., at : at + width] for view, at in zip(around, starts, strict=True)]
        )
        colours.append((other[:, :3] - layers[:, :3]).abs().mean(1))
        beside.append(1 - other[:, 3])
    volume = torch.stack([*colours, *beside], dim=1)
    return avg_pool2d(avg_pool2d(volume, 3, 1, 1, count_include_pad=False), 2)


def refined(coarse: Tensor, weights: Tensor, inside: Tensor) -> Tensor:
    """Return (B, 1, 4 h, 4 w) means of 3x3 values of ``coarse`` (B, 1, h, w), weighted by the
    softmax of ``weights``.

    ``weights`` (B, 9 * 16, h, w) are logits of the nine, for each of the 16 pixels (convex
    upsampling, Teed and Deng 2020), next to those of a Gaussian around the pixel. Values where
    ``inside`` (B, 1, h, w) is 0 do not count.
    """
    batch, _, height, width = coarse.shape
    values, known = (
        unfold(pad(x, (1, 1, 1, 1), mode=mode), 3).view(batch, 9, 1, 1, height, width)
        for x, mode in ((coarse, "replicate"), (inside, "constant"))
    )
    logits = weights.view(batch, 9, QUARTER, QUARTER, height, width) + _near_first(coarse)
    shares = torch.where(known > 0, logits, _NEVER).softmax(dim=1)
    fine = (shares * values).sum(1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, QUARTER * height, QUARTER * width)


def _near_first(like: Tensor) -> Tensor:
    """Return logits (9, 4, 4, 1, 1) of 3x3 values for each of 4x4 pixels in the middle: of their
    squared distance."""
    pixel = (torch.arange(QUARTER, dtype=like.dtype, device=like.device) + 0.5) / QUARTER - 0.5
    square = (
        torch.arange(-1.0, 2.0, dtype=like.dtype, device=like.device)[:, None] - pixel
    ).square()
    return -_SHARPNESS * (square[:, None, :, None] + square[None, :, None, :]).reshape(
        9, QUARTER, QUARTER, 1, 1
    )


WIDTHS = (24, 40, 64)
"""Channels of the features of images at 1/4, 1/8 and 1/16 of the resolution."""
HEADS = {"rotation": 4, "scale": 3, "opacity": 1}
"""Outputs per pixel and their number of channels."""
LARGEST = 4.0
"""Largest standard deviation, in pixels of the window at the depth of the pixel: 2 cm for a person
of 256 px images."""
_SCALE_LOGIT = -1.95
_OPACITY_LOGIT = 4.0  # Of an untrained network: half a pixel, nearly opaque
_DEPTH_WIDTHS = (16, 24, 32)  # Channels of the features of depth
_LAST = 32  # Channels of the features that Gaussians are made from
_RANGE = 64.0  # px; offsets are divided by it before they enter a network
_LEAST = 0.2  # Smallest disparity, relative to that of the middle of the person


class GpsNetwork(nn.Module):
    """Depth and Gaussians of two rectified views; features of the images are shared by both tasks.

    It works at half the resolution of the windows, of which it is given four pixels as one, and
    returns four as one.
    """

    def __init__(self, generator: torch.Generator) -> None:
        """Weights are drawn from ``generator`` on the CPU."""
        super().__init__()
        half, quarter, _ = WIDTHS
        with torch.device("cpu"):
            self.encoder = Encoder(16, WIDTHS)
            self.stereo = StereoNetwork(WIDTHS)
            self.depth_encoder = Encoder(8, _DEPTH_WIDTHS)
            below = quarter + _DEPTH_WIDTHS[1] + _DEPTH_WIDTHS[2]
            self.up = nn.ModuleList(
                nn.Sequential(nn.Conv2d(before, half, 3, padding=1), ResidualBlock(half))
                for before in (below, 2 * half + _DEPTH_WIDTHS[0])
            )
            self.last = nn.Sequential(nn.Conv2d(half + 20, _LAST, 3, padding=1), nn.SiLU())
            self.heads = nn.Conv2d(_LAST, 4 * sum(HEADS.values()), 1)
        initialize_weights(self, generator)
        for layer in (self.heads, self.stereo.change, self.stereo.weights):
            nn.init.zeros_(layer.weight)

    def forward(
        self, pair: RectifiedPair, *, with_gaussians: bool = True
    ) -> tuple[list[Tensor], Tensor | None]:
        """Return offsets (2, 1, H, W) of ``pair``, px, of which the last are the finest, and what makes
        Gaussians of its pixels (2, 8, H, W) in the order of ``HEADS``."""
        inside = pair.solid.float()
        images = pixel_unshuffle(torch.cat([(2 * pair.rgb - 1) * inside, pair.alpha], dim=1), 2)
        levels = self.encoder(images)
        around = offsets_of(pair.shift)
        offsets, fused = self.stereo(
            levels, plane_sweep_costs(pair.rgb, pair.alpha, around), around, inside
        )
        if not with_gaussians:
            return offsets, None
        depth = pixel_unshuffle(torch.cat([offsets[-1] / _RANGE * inside, inside], dim=1), 2)
        halves, quarters, eighths = self.depth_encoder(depth)
        features = self.up[0](torch.cat([fused, quarters, upsample(eighths)], dim=1))
        features = self.up[1](torch.cat([upsample(features), levels[0], halves], dim=1))
        features = self.last(torch.cat([upsample(features), images, depth[:, :4]], dim=1))
        return offsets, pixel_shuffle(self.heads(features), 2)


def surface_gaussians_of_pair(pair: RectifiedPair, offsets: Tensor, raw: Tensor) -> Gaussians:
    """Return the Gaussians of the pixels of the person in both views, differentiable in
    their ``offsets`` (2, 1, H, W) and ``raw`` values (2, 8, H, W).

    Means lie on the rays through the pixels, rotations are relative to the axes of the windows,
    colours are those of the images. Outlines are as transparent as in the images; what the other
    view would show beside the person, wholly (visual hull).
    """
    offsets = torch.maximum(offsets, (_LEAST - 1) * pair.shift)
    depth = pair.depth(offsets)
    solid = pair.solid[:, 0]
    parts = raw.permute(0, 2, 3, 1)[solid].split(tuple(HEADS.values()), dim=1)
    part = dict(zip(HEADS, parts, strict=True))
    pixel = (depth[:, 0][solid] / pair.focal)[:, None]
    scales = LARGEST * pixel * (part["scale"] + _SCALE_LOGIT).sigmoid()
    within = (pair.alpha * pair.seen_by_other(offsets))[solid[:, None]]
    opacities = (part["opacity"][:, 0] + _OPACITY_LOGIT).sigmoid() * within
    opacities = opacities.clamp(1e-4, 1 - 1e-4)
    one = part["rotation"].new_tensor([1.0, 0.0, 0.0, 0.0])
    world_from_rect = quats_from_matrices(pair.rect_from_world.T[None])
    rgb = pair.rgb.permute(0, 2, 3, 1)[solid]
    return Gaussians(
        means=pair.points(depth)[solid],
        quats=quat_product(world_from_rect.expand(len(rgb), 4), unit_quats(one + part["rotation"])),
        log_scales=scales.clamp_min(1e-12).log(),
        logit_opacities=(opacities / (1 - opacities)).log(),
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )


def offset_loss(pair: RectifiedPair, offsets: Sequence[Tensor], decay: float) -> Tensor:
    """Return the weighted sum of the mean errors of ``offsets``, px, where the truth is known.

    The last ones count 1, each before ``decay`` times the next (Teed and Deng 2020).
    """
    known = pair.solid & pair.offsets.isfinite()
    truth = pair.offsets[known]
    total = torch.zeros((), device=pair.rgb.device)
    for i, found in enumerate(reversed(offsets)):
        total = total + decay**i * (found[known] - truth).abs().mean()
    return total


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
        return best_pair(self.views) if count == 2 else spread_around_person(self.views, count)

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
            sides=ViewSides.joined(found, centers) if len(pairs) > 1 else None,
            options=render_options(self.config.model),
            background=self.background,
        )

    def _surface(self, left: Image, right: Image) -> Gaussians:
        """Return the surface that two views show, inside both silhouettes."""
        pair = rectify_views(left, right, self.section.person_px)
        offsets, raw = self.network(pair)
        gaussians = surface_gaussians_of_pair(pair, offsets[-1], raw)
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
        data = self.data_at_time(self.views[views[0]].time, times)
        return preset.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.start_from(scene, StaticTraining(FilterUpdate()))


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
        self._opened = keep_captures_open(_lessons, people)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        images, pairs = self._opened(person)
        pair, between = pairs[random_index(len(pairs), generator)]
        target = between[random_index(len(between), generator)]
        background = self.sample_background(generator)
        left, right = (images[i] for i in pair)
        windows = rectify_views(left, right, self.section.person_px)
        windows = move_fields_to(windows, self.device)
        only_depth = step <= round(DEPTH_FRACTION * self.config.train.steps)
        offsets, raw = self.network(windows, with_gaussians=not only_depth)
        depth_loss = offset_loss(windows, offsets, DECAY)
        if only_depth:
            found = _picture(windows, offsets[-1].detach())
            return Example(depth_loss, left, found, _picture(windows, windows.offsets))
        gaussians = surface_gaussians_of_pair(windows, offsets[-1], raw)
        image = crop_to_person(images[target], _AROUND).to(self.device)
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
    pairs = training_pairs(views)
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
            f"{data.root}: the images have no silhouettes; give them alpha, see `dyngs docs people`"
        )
    return capture


def _picture(pair: RectifiedPair, offsets: Tensor) -> Tensor:
    """Return (H, W, 3) offsets of the left view as a picture, grey in the middle, black outside of
    the person."""
    grey = (0.5 + offsets[0, 0] / pair.shift).nan_to_num(0.0).clamp(0, 1) * pair.solid[0, 0]
    return grey[..., None].expand(-1, -1, 3)


def learner(config: Config, generator: torch.Generator) -> GpsLearner:
    """Return the network of ``model.kind: gps`` before the first step."""
    device = select_device(config.run.device)
    return GpsLearner(config, GpsNetwork(generator).to(device), list_captures(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    log: Callable[[str], None],
    report: ProgressCallback,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the capture of ``data``."""
    network = GpsNetwork(torch.Generator())
    load_weights(network, checkpoint)
    return GpsPredictor(config, network, _with_silhouettes(data), data)
