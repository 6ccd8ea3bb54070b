"""GHG (Kwon et al. 2024): a U-Net over the UV map that predicts an avatar from a few images.

Observations of the images are collected per texel (``TexelMaps``), the network predicts Gaussians
on several scaffolds above the skin. Training uses captures of several people.

Symbols: D input channels, K scaffolds, P texels, S texels per side, M vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from statistics import mode
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.nn.functional import elu, max_pool2d, normalize, pad

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.state import move_fields_to
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.data.geometry import camera_center
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.schedule import RateSchedule
from dyngs.human.avatar.observations import FACING_EXPONENT, project_points
from dyngs.human.avatar.posing import Skeleton, pose_blend_shapes, texel_gaussians
from dyngs.human.avatar.scene import HumanScene, initial_human_scene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate, skin
from dyngs.human.body.body_reader import load_template
from dyngs.human.fit.fitted_capture import ensure_fitted_body
from dyngs.human.keys import HumanModel, HumanPredictorModel
from dyngs.human.predict.gps.rectification import spread
from dyngs.human.predict.people import (
    Person,
    captured_person,
    depths,
    image_planes,
    mesh_normals,
    sample_maps,
)
from dyngs.models.checkpoint import CONFIG_ADVICE, Checkpoint
from dyngs.models.prediction import (
    Encoder,
    Example,
    Learner,
    Predictor,
    ResidualBlock,
    image_loss,
    initialize_weights,
    load_weights,
    optimizer_step,
    random_index,
    random_item,
    upsample,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.device import select_device
from dyngs.ops.quaternions import quat_product, unit_quats


@dataclass(frozen=True)
class AtlasPerson:
    """Captured person with the texels of the UV map, as input of a prediction."""

    person: Person
    scaffolds: Tensor  # (K, M, 3) vertices in the rest pose, m
    texels: Texels  # P, in the person's shape
    mirror: Tensor  # (P,) index of the mirrored texel
    heights: tuple[float, ...]  # (K,) of the scaffolds, m, ascending
    scene: HumanScene  # K P grey discs, ordered by scaffold

    def observe(self, views: Sequence[int]) -> TexelMaps:
        """Return the texel maps of some views."""
        return observe_texels(self, [self.person.images[i] for i in views])


def atlas_person(person: Person, model: HumanPredictorModel) -> AtlasPerson:
    """Sample the body of a person at the texels of ``model``."""
    body = person.body
    texels = atlas_texels(body, model.resolution, body.vertices)
    heights = tuple(sorted(set(model.scaffold_heights)))
    gaussians, anchors = texel_gaussians(texels, heights, 0)
    skeleton = Skeleton(body.joints, body.parents)
    normals = mesh_normals(body.vertices, body.faces)
    return AtlasPerson(
        person=person,
        scaffolds=body.vertices + texels.points.new_tensor(heights)[:, None, None] * normals,
        texels=texels,
        mirror=mirror_texels(texels),
        heights=heights,
        scene=initial_human_scene(
            gaussians, anchors, skeleton, person.motion.clip, pose_blend_shapes(body)
        ),
    )


def spread_views(person: AtlasPerson, count: int, first: int | None = None) -> list[int]:
    """Return ``count`` view indices, ascending, spread evenly around the body.

    The views start from the most frontal one, or from ``first``, and show one frame, if it has
    enough views. All views if there are fewer than ``count``.
    """
    views = person.person.views
    frames = [view.frame for view in views]
    frame = mode(frames) if first is None else frames[first]
    candidates: Sequence[int] = [i for i, other in enumerate(frames) if other == frame]
    if len(candidates) < count:
        candidates = range(len(views))
    azimuths = {i: _azimuth(person, views[i]) for i in candidates}
    ring = sorted(candidates, key=lambda i: azimuths[i])
    if first is None:
        first = min(ring, key=lambda i: abs(azimuths[i]))
    return sorted(set(spread(ring, count, ring.index(first))))


def _azimuth(person: AtlasPerson, view: View) -> float:
    """Return the azimuth of a camera around the body, rad; 0 is in front."""
    pose = person.person.pose_in(view)
    center = torch.from_numpy(camera_center(view.cam_from_world)).to(pose.trans)
    pelvis = pose.scale * person.scene.skeleton.joints[0] + pose.trans
    x, _, z = pose.rotations[0].T @ (center - pelvis)
    return float(torch.atan2(x, z))


_NEAREST = 16  # observed texels that give an unseen one its colour
_NORMAL_SCALE = 0.1  # distance, m, equivalent to a rotation of the normal by 60 degrees
_SOFT_DISTANCE = 0.01  # added to distances, m, so that the nearest texel does not dominate
_UNKNOWN = 0.5


def mirror_texels(texels: Texels) -> Tensor:
    """Return the index (P,) of the texel nearest to the mirror image of each, in the rest pose."""
    positions = _positions(texels)
    nearest = KDTree(positions).query(positions * np.array([-1.0, 1, 1, -1, 1, 1]))[1]
    return torch.as_tensor(nearest, device=texels.index.device)


def fill_unseen_colours(texels: Texels, rgb: Tensor, seen: Tensor) -> Tensor:
    """Fill colours (P, 3) of texels with ``seen`` (P,) zero from observed texels nearby in the
    rest pose.

    Weights fall with the squared distance, which includes the normal, and grow with the viewing
    cosine. 0.5 if nothing is observed.
    """
    observed = (seen > 0).nonzero()[:, 0]
    hidden = (seen <= 0).nonzero()[:, 0]
    if not len(observed):
        return torch.full_like(rgb, _UNKNOWN)
    positions = _positions(texels)
    # SciPy drops the axis of a single neighbour unless its rank is given.
    ranks: Any = np.arange(min(_NEAREST, len(observed))) + 1
    search = KDTree(positions[observed.cpu()])
    distance, near = (torch.from_numpy(x) for x in search.query(positions[hidden.cpu()], k=ranks))
    rows = observed[near.to(observed.device)]
    weight = (seen[rows] / (distance.to(rgb) + _SOFT_DISTANCE).square())[..., None]
    return rgb.index_copy(0, hidden, (weight * rgb[rows]).sum(1) / weight.sum(1))


def _positions(texels: Texels) -> np.ndarray:
    """Return positions and scaled normals (P, 6) of the texels in the rest pose, m."""
    return torch.cat([texels.points, _NORMAL_SCALE * texels.normals], dim=1).double().cpu().numpy()


_MIN_COSINE = 0.15  # viewing cosine below which a texel is not observed
MAX_SILHOUETTE_DISTANCE = 0.06  # limit on distances to the silhouette edge, m
_TOLERANCE, _TOLERANCE_PX = 0.01, 1.5  # of the depth test: m, and pixels along the surface


@dataclass(frozen=True)
class TexelMaps:
    """Observations of a few images, per texel and scaffold."""

    rgb: Tensor  # (K, P, 3) mean colours, weighted towards frontal views; 0 where unobserved
    seen: Tensor  # (K, P) largest viewing cosine, 0 where occluded
    inside: Tensor  # (K, P) fraction of views (with the texel in frame) whose silhouette covers it
    # (K, P) smallest signed distance to a silhouette edge over the views, m, positive inside,
    # clamped to ``MAX_SILHOUETTE_DISTANCE``
    silhouette_distance: Tensor
    # (P, 3) unit vectors between scaffolds in the first view's pose, relative to the pelvis
    offsets: Tensor
    nearby: Tensor  # (P, 3) colours of the lowest scaffold, filled where unobserved
    count: int  # number of views


@torch.no_grad()
def observe_texels(person: AtlasPerson, images: Sequence[Image]) -> TexelMaps:
    """Collect the texel maps of one or more images."""
    body = person.person.body
    faces = body.faces
    offsets: list[Tensor] = []
    observed = []
    for image in images:
        pose = person.person.pose_in(image)
        camera = image.cameras
        focal = camera.intrinsics[0, 0, 0]
        rgba = image_planes(image)
        planes = torch.cat([rgba, _edge_distances(rgba[3])[None]])
        posed, _ = skin(body, person.scaffolds, body.joints, pose.rotations)
        scaffolds = pose.scale * posed + pose.trans
        normals = normalize(_at_texels(person, mesh_normals(scaffolds[0], faces)), dim=1)
        offsets.append(normals @ pose.rotations[0])
        for vertices in scaffolds:
            world = _at_texels(person, vertices)
            at, depth, in_frame = project_points(world, camera)
            to_camera = normalize(camera.centers[0] - world, dim=1)
            cosine = (to_camera * normals).sum(1)
            sampled = _sampled(planes, at) * in_frame[:, None]
            covered = sampled[:, 3]
            pixel = depth / focal
            # On slanted surfaces, pixels around a texel show points that are nearer by the pixel
            # width over the cosine.
            slanted = pixel / cosine.clamp_min(_MIN_COSINE)
            nearest = _nearest_depth(vertices, faces, camera, at)
            is_clear = depth <= nearest + pose.scale * _TOLERANCE + _TOLERANCE_PX * slanted
            is_seen = is_clear & in_frame & (cosine > _MIN_COSINE) & (covered > 0.5)
            cosine = torch.where(is_seen, cosine, 0.0)
            weight = cosine**FACING_EXPONENT
            # in metres of the body, for texels within the frame
            to_edge = torch.where(
                in_frame, sampled[:, 4] * pixel / pose.scale, MAX_SILHOUETTE_DISTANCE
            )
            colour = weight[:, None] * sampled[:, :3]
            is_inside = covered > 0.5
            observed.append((colour, weight * covered, cosine, is_inside, in_frame, to_edge))
    # Each (V, K, P, ...)
    colour, weight, cosine, is_inside, in_frame, to_edge = (
        torch.stack(x).unflatten(0, (len(images), -1)) for x in zip(*observed, strict=True)
    )
    rgb = (colour.sum(0) / weight.sum(0).clamp_min(1e-6)[..., None]).clamp(0, 1)
    seen = cosine.amax(0)
    in_frames = in_frame.sum(0)
    fraction = torch.where(in_frames > 0, is_inside.sum(0) / in_frames.clamp_min(1), 1.0)
    return TexelMaps(
        rgb,
        seen,
        fraction,
        to_edge.amin(0).clamp(-MAX_SILHOUETTE_DISTANCE, MAX_SILHOUETTE_DISTANCE),
        offsets[0],
        fill_unseen_colours(person.texels, rgb[0], seen[0]),
        len(images),
    )


def to_atlas(values: Tensor, texels: Texels) -> Tensor:
    """Scatter ``values`` (P, D) at the texels into a map (D, S, S), 0 elsewhere."""
    atlas = values.new_zeros(values.shape[1], texels.resolution**2)
    atlas[:, texels.index] = values.T
    return atlas.unflatten(1, (texels.resolution, texels.resolution))


def from_atlas(atlas: Tensor, texels: Texels) -> Tensor:
    """Gather values (P, D) at the texels from a map (D, S, S); differentiable."""
    return atlas.flatten(1).index_select(1, texels.index).T


def _edge_distances(alpha: Tensor) -> Tensor:
    """Return signed distances (H, W) to the edge of a silhouette (H, W), px, positive inside.

    At the edge they are alpha - 0.5, which is exact for a vertical edge.
    """
    is_inside = np.pad((alpha > 0.5).cpu().numpy(), 1)
    inside, outside = (np.asarray(distance_transform_edt(x)) for x in (is_inside, ~is_inside))
    signed = torch.from_numpy((inside - outside)[1:-1, 1:-1]).to(alpha)
    return torch.where(signed.abs() > 1, signed - signed.sign() / 2, alpha - 0.5)


def _nearest_depth(vertices: Tensor, faces: Tensor, camera: Cameras, at: Tensor) -> Tensor:
    """Return the smallest depth (P,) of a mesh in the four pixels around ``at`` (P, 2); infinite
    outside."""
    depth = depths(vertices, faces, camera)
    # The minimum of 2 x 2 pixels, infinite beyond the image.
    least = -max_pool2d(-pad(depth, (1, 1, 1, 1), value=torch.inf)[None], 2, 1)
    return _sampled(least, at + 0.5, "nearest")[:, 0]


def _sampled(planes: Tensor, at: Tensor, mode: str = "bilinear") -> Tensor:
    """Sample planes (D, H, W) at columns and rows ``at`` (P, 2); return (P, D)."""
    grid = 2 * at / at.new_tensor(planes.shape[:0:-1]) - 1
    return sample_maps(planes[None], grid[None], mode, "border")[0]


def _at_texels(person: AtlasPerson, values: Tensor) -> Tensor:
    """Interpolate vertex values (M, 3) at the texels; return (P, 3)."""
    corners = person.person.body.faces[person.texels.faces]
    return (person.texels.barycentric[..., None] * values[corners]).sum(1)


WIDTHS = (24, 32, 48, 64)
"""Channels of the U-Net at 1/2, 1/4, ... of the resolution of the UV map."""
SILHOUETTE_FRACTION = 0.9
"""Fraction of silhouettes that must contain a Gaussian above the lowest scaffold."""
HEADS = {
    "rotation": 4,
    "scale": 3,
    "opacity": 1,
    "height": 1,
    "colour": 3,
    "image_weight": 1,
    "guess": 3,
}
"""Output channels per texel of a scaffold, see ``predict_avatar``."""


class GatedConv(nn.Conv2d):
    """Gated convolution (Yu et al. 2019): ELU of some channels times the sigmoid of as many.

    Twice the sigmoid, which is about 1 before training, so that deep features do not vanish.
    """

    def __init__(self, before: int, width: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__(before, 2 * width, 3, stride, dilation, dilation)

    def forward(self, input: Tensor) -> Tensor:
        values, gates = super().forward(input).chunk(2, dim=1)
        return elu(values) * (2 * gates.sigmoid())


class Inpainting(nn.Module):
    """Fills holes in the colours of the lowest scaffold by gated convolutions, as GHG does.

    One stage, without the discriminator: it is trained with the rest on the rendered images.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            GatedConv(5, 24),
            GatedConv(24, 48, stride=2),
            GatedConv(48, 64, stride=2),
            *(GatedConv(64, 64, dilation=2**i) for i in range(1, 4)),
            nn.Upsample(scale_factor=2),
            GatedConv(64, 48),
            nn.Upsample(scale_factor=2),
            GatedConv(48, 24),
            nn.Conv2d(24, 3, 3, padding=1),
        )

    def forward(self, rgb: Tensor, hole: Tensor, texels: Tensor) -> Tensor:
        """Return ``rgb`` (3, S, S) with its ``hole`` (1, S, S) filled; ``texels`` (1, S, S) are 1
        on the skin."""
        known = rgb * (1 - hole)
        return known + hole * self.layers(torch.cat([known, hole, texels])[None])[0].sigmoid()


class AtlasNetwork(Encoder):
    """U-Net from maps (D, S, S) to raw predictions (K, 16, S, S) in the order of ``HEADS``.

    Predictions are 0 before training. Each width halves the resolution; the last layer also gets
    the input.
    """

    def __init__(self, model: HumanPredictorModel, generator: torch.Generator) -> None:
        """Create the network of ``model`` on the CPU with weights from ``generator``."""
        factor = 2 ** len(WIDTHS)
        if model.resolution % factor:
            raise DyngsError(f"model.resolution={model.resolution} must be a multiple of {factor}")
        scaffolds = len(set(model.scaffold_heights))
        channels = 6 * scaffolds + 18  # of ``network_inputs``
        with torch.device("cpu"):
            super().__init__(channels, WIDTHS)
            self.scaffolds = scaffolds
            self.up = nn.ModuleList(
                nn.Sequential(nn.Conv2d(below + width, width, 3, padding=1), ResidualBlock(width))
                for below, width in pairwise(WIDTHS[::-1])
            )
            self.last = nn.Sequential(
                nn.Conv2d(WIDTHS[0] + channels, WIDTHS[0], 3, padding=1), nn.SiLU()
            )
            self.heads = nn.Conv2d(WIDTHS[0], scaffolds * sum(HEADS.values()), 1)
            self.inpainting = Inpainting() if model.unseen_colours == "inpainted" else None
        initialize_weights(self, generator)
        nn.init.zeros_(self.heads.weight)

    def forward(self, maps: Tensor) -> Tensor:
        """Return the raw predictions (K, 16, S, S); S must be a multiple of 2 to the number of
        widths."""
        levels = self.levels(maps[None])
        features = levels.pop()
        for layer in self.up:
            features = layer(torch.cat([upsample(features), levels.pop()], dim=1))
        features = self.last(torch.cat([upsample(features), maps[None]], dim=1))
        return self.heads(features)[0].unflatten(0, (self.scaffolds, -1))


_MAX_LOG_SCALE = 1.5  # limit on the change of log scales from the initial Gaussian
_IMAGE_LOGIT = 4.0  # initial logit of image colours against predicted colours
_GUESS_LOGITS = (0.0, 2.0, 0.0)  # initial logits of the three colours of ``guess_unseen_colours``
_MAX_HEIGHT = 0.01  # limit on offsets along the normal with a single scaffold, m


def network_inputs(person: AtlasPerson, maps: TexelMaps, guesses: Tensor) -> Tensor:
    """Return the network input (D, S, S).

    Per scaffold: colour, cosine, silhouettes; then offsets, positions, and ``guesses`` (3, P, 3).
    """
    measured = torch.stack(
        [maps.seen, maps.inside, maps.silhouette_distance / MAX_SILHOUETTE_DISTANCE], dim=-1
    )
    scaffolds = torch.cat([maps.rgb, measured], dim=-1)
    ones = torch.ones(len(person.texels), 1, device=scaffolds.device)
    shared = [
        maps.offsets,
        person.texels.points,
        *guesses,
        maps.seen[0][person.mirror, None],
        ones,
        ones / maps.count,
    ]
    return to_atlas(torch.cat([*scaffolds, *shared], dim=1), person.texels)


def guess_unseen_colours(person: AtlasPerson, maps: TexelMaps, mean: Tensor) -> Tensor:
    """Return three candidate colours (3, P, 3) for unobserved texels.

    The mean colour of the training people (``mean`` (3, S, S)), that of observed texels nearby,
    and that of the mirrored texel where it is observed (else nearby).
    """
    is_mirror_seen = maps.seen[0][person.mirror, None] > 0
    mirrored = torch.where(is_mirror_seen, maps.rgb[0][person.mirror], maps.nearby)
    return torch.stack([from_atlas(mean, person.texels), maps.nearby, mirrored])


def inpaint_colours(
    person: AtlasPerson, maps: TexelMaps, network: Inpainting
) -> tuple[Tensor, Tensor]:
    """Return the colours (P, 3) of the lowest scaffold with its hole filled, and the texels (P,)
    beside the hole.

    The hole are the unobserved texels, dilated by 5 x 5.
    """
    seen = (maps.seen[:1] > 0).to(maps.rgb).T
    texels = to_atlas(torch.ones_like(seen), person.texels)
    hole = texels * max_pool2d(texels - to_atlas(seen, person.texels), 5, 1, 2)
    painted = network(to_atlas(maps.rgb[0], person.texels), hole, texels)
    return from_atlas(painted, person.texels), from_atlas(hole, person.texels)[:, 0] == 0


def predict_avatar(
    person: AtlasPerson, maps: TexelMaps, mean: Tensor, network: AtlasNetwork
) -> HumanScene:
    """Predict an avatar; differentiable in the weights of ``network``.

    The lowest scaffold gets a Gaussian per texel, upper ones only where a view observes the texel
    and ``SILHOUETTE_FRACTION`` of the silhouettes contain it. Rotations are relative to the
    tangent frame, scales to the initial Gaussian, means move along the normal. Colours blend those
    of the images with a guess plus a correction: a mixture of ``guess_unseen_colours``, or the
    colours of ``inpaint_colours``. ``mean`` (3, S, S) is as in the former.
    """
    kept = (maps.inside >= SILHOUETTE_FRACTION) & (maps.seen > 0)
    kept[0] = True
    rows = kept.flatten().nonzero()[:, 0]
    scene = person.scene.select(rows)
    first = scene.gaussians
    texel = rows % len(person.texels)
    guesses = guess_unseen_colours(person, maps, mean)
    raw = network(network_inputs(person, maps, guesses))
    raw = torch.cat([from_atlas(level, person.texels) for level in raw]).index_select(0, rows)
    part = dict(zip(HEADS, raw.split(tuple(HEADS.values()), dim=1), strict=True))
    weight = (part["image_weight"] + _IMAGE_LOGIT).sigmoid()
    is_seen = maps.seen > 0
    if network.inpainting is None:
        fractions = (part["guess"] + part["guess"].new_tensor(_GUESS_LOGITS)).softmax(dim=1)
        guess = (fractions.T[..., None] * guesses[:, texel]).sum(0)
    else:
        painted, is_seen[0] = inpaint_colours(person, maps, network.inpainting)
        guess = painted[texel]
    weight = weight * is_seen.flatten()[rows, None]
    rgb = torch.lerp(guess + part["colour"], maps.rgb.flatten(0, 1)[rows], weight)
    one = rgb.new_tensor([1.0, 0.0, 0.0, 0.0])
    limit = min((0.5 * (b - a) for a, b in pairwise(person.heights)), default=_MAX_HEIGHT)
    gaussians = Gaussians(
        means=first.means + limit * part["height"].tanh() * person.texels.normals[texel],
        quats=quat_product(first.quats, unit_quats(one + part["rotation"])),
        log_scales=first.log_scales + _MAX_LOG_SCALE * (part["scale"] / _MAX_LOG_SCALE).tanh(),
        logit_opacities=first.logit_opacities + part["opacity"][:, 0],
        sh=((rgb - 0.5) / SH_C0)[:, None],
    )
    return replace(scene, gaussians=gaussians)


VIEW_CHOICES_PER_PERSON = 6  # source view sets per person in training; their maps are cached
TARGET_VIEWS = 2  # target images per training step, of one time step
SQUARED_WEIGHT = 1.0  # of the mean squared error in the loss, which emphasises edges
MEAN_COLOUR_VIEWS = 8  # images per person for the mean colours
ADAPTATION_STEPS = 10  # training steps on the input images before a prediction
ADAPTATION_RATE = 1e-4
"""Initial learning rate of Adam per input image, falling linearly; more images allow more."""
_MIN_OPACITY = 0.02  # of predicted Gaussians, as in the preset ``human``


class PersonPredictor(Predictor[AtlasNetwork]):
    """Predictor of avatars, optionally trained on the input images of a person (``adapt``)."""

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        data: DataConfig,
        log: Callable[[str], None],
        on_progress: ProgressCallback,
    ) -> None:
        """Load the network of ``checkpoint`` and the person of ``data``; fit the body if needed.

        ``log`` and ``on_progress`` receive messages and progress of that fit.
        """
        model: Any = config.model
        network = AtlasNetwork(model, torch.Generator())
        self.mean = load_network(network, checkpoint, model.resolution)
        options = human_options(model)
        data = ensure_fitted_body(
            data, options, only_if_needed=True, log=log, on_progress=on_progress
        )
        self._person = read_atlas_person(data, model, load_template(options))
        super().__init__(config, network, self._person.person.views, data)

    def chosen(self, count: int) -> list[int]:
        return spread_views(self._person, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> HumanScene:
        scene = self._scene(self._person.observe(views))
        return scene.select(scene.gaussians.opacities >= _MIN_OPACITY)

    def adapt(
        self,
        views: Sequence[int],
        steps: int | None = None,
        on_progress: ProgressCallback = ignore_progress,
    ) -> int:
        """Train the network on the input images; return the number of steps."""
        steps = ADAPTATION_STEPS if steps is None else steps
        images = [self._person.person.images[i] for i in views]
        maps = self._person.observe(views)
        rate = ADAPTATION_RATE * len(views)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        for step in range(steps):
            person = self._person.person
            loss, _, _ = _images_error(
                self._scene(maps), person, images, self.background, self.config
            )
            if not optimizer_step(optimizer, self.network, loss, rate * (1.0 - step / steps)):
                break
            on_progress("adapting to the images", step + 1, steps)
        return steps

    def run_config(self, views: Sequence[int]) -> Config:
        """Return the preset for one person, with the template of the network."""
        preset = load_config(packaged_preset("human"), ["data.root=."])
        shared_keys = {"body", "uv", "resolution", "near", "eps2d", "rasterize_mode", "sh_degree"}
        shared = human_options(self.section).model_dump(include=shared_keys)
        human = preset.model.model_copy(update=shared)
        return preset.model_copy(update={"data": self.data, "model": human})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        assert isinstance(config.model, HumanModel)
        frames = self._person.person.motion.frames
        model.start_from(
            scene, HumanTraining(config.model, frames, RateSchedule(config.train.steps))
        )

    def _scene(self, maps: TexelMaps) -> HumanScene:
        return predict_avatar(self._person, maps, self.mean, self.network)


class AtlasLearner(Learner[AtlasNetwork]):
    """Trains on predictions from one set of views, compared with other views of one time step."""

    def __init__(self, config: Config, generator: torch.Generator) -> None:
        """Read the captures; choose source views of each person, whose maps are cached."""
        device = select_device(config.run.device)
        model: Any = config.model
        body = load_template(human_options(model))
        network = AtlasNetwork(model, generator).to(device)
        self.people = [read_atlas_person(data, model, body) for data in list_captures(config.data)]
        super().__init__(config, network, [x.person.name for x in self.people], device)
        self.source_choices = [_choices(x, model.source_views, generator) for x in self.people]
        self.mean = mean_colours(self.people, model.resolution).to(device)
        self._moved = [move_fields_to(x, device) for x in self.people]
        self._maps = cache(self._observed)

    def _observed(self, person: int, choice: int) -> TexelMaps:
        maps = self.people[person].observe(self.source_choices[person][choice])
        return move_fields_to(maps, self.device)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        person_data = self.people[person].person
        choice = random_index(len(self.source_choices[person]), generator)
        targets = self._targets(person_data, self.source_choices[person][choice], generator)
        background = self.sample_background(generator)
        maps = self._maps(person, choice)
        moved = self._moved[person]
        scene = predict_avatar(moved, maps, self.mean, self.network)
        loss, rendered, truth = _images_error(scene, moved.person, targets, background, self.config)
        return Example(loss, targets[-1], rendered.detach(), truth, len(scene))

    def kept(self) -> dict[str, Tensor]:
        return {"mean": self.mean}

    def load(self, checkpoint: Checkpoint) -> None:
        mean = load_network(self.network, checkpoint, self.section.resolution)
        self.mean = mean.to(self.device)

    def _targets(
        self, person: Person, inputs: list[int], generator: torch.Generator
    ) -> list[Image]:
        """Return images of one time step that are not among the sources, if possible."""
        views = person.views
        others = [i for i in range(len(views)) if i not in inputs] or inputs
        frame = views[random_item(others, generator)].frame
        same_frame = [i for i in others if views[i].frame == frame]
        order = torch.randperm(len(same_frame), generator=generator, device="cpu").tolist()
        return [person.images[same_frame[i]].to(self.device) for i in order[:TARGET_VIEWS]]


learner = AtlasLearner


predictor = PersonPredictor


def load_network(network: AtlasNetwork, checkpoint: Checkpoint, resolution: int) -> Tensor:
    """Load the weights of a checkpoint into ``network``; return its mean colours (3, S, S)."""
    load_weights(network, checkpoint)
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        mean = checkpoint.tensors["model.mean"]
        return require_tensor("mean", mean, (3, resolution, resolution))


def human_options(model: HumanPredictorModel) -> HumanModel:
    """Return the avatar section with the same template and texels, and no learned corrections."""
    template_keys = {"body", "uv", "resolution"}
    render_keys = {"near", "eps2d", "rasterize_mode", "alpha_min", "transmittance_min"}
    shared = model.model_dump(include=template_keys | render_keys)
    return HumanModel.model_validate({"sh_degree": 0, "refine": False} | shared)


def read_atlas_person(
    data: DataConfig, model: HumanPredictorModel, body: BodyTemplate
) -> AtlasPerson:
    """Read the person of one capture."""
    capture = read_capture(data)
    images = ImageLoader(capture.splits["train"], data)
    return atlas_person(captured_person(capture, body, images), model)


def mean_colours(people: list[AtlasPerson], resolution: int) -> Tensor:
    """Return the mean colours (3, S, S) of the lowest scaffold over people.

    Texels that nobody shows get the overall mean.
    """
    sums = torch.zeros(4, resolution, resolution, device="cpu")
    for person in people:
        maps = person.observe(spread_views(person, MEAN_COLOUR_VIEWS))
        is_seen = maps.seen[0, :, None] > 0
        sums += to_atlas(torch.cat([maps.rgb[0], is_seen], dim=1), person.texels)
    total, count = sums.split((3, 1))
    overall = total.sum((1, 2)) / count.sum().clamp_min(1)
    return torch.where(count > 0, total / count.clamp_min(1), overall[:, None, None])


def _choices(person: AtlasPerson, source_views: int, generator: torch.Generator) -> list[list[int]]:
    """Return source view sets, each of a random time step, spread around a random view.

    Every other set has fewer than ``source_views`` views, in turn each number from 1.
    """
    firsts = torch.randint(
        len(person.person.views), (VIEW_CHOICES_PER_PERSON,), generator=generator, device="cpu"
    )
    choices = []
    for i, first in enumerate(firsts.tolist()):
        fewer = 1 + i // 2 % max(source_views - 1, 1)
        choices.append(spread_views(person, fewer if i % 2 else source_views, first))
    return choices


def _images_error(
    scene: HumanScene,
    person: Person,
    images: Sequence[Image],
    background: Tensor,
    config: Config,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean loss of renders in the poses of ``person`` against images, and the last
    render and image."""
    options = replace(render_options(config.model), nonfinite="trust")
    total = torch.zeros((), device=background.device)
    for image in images:
        time_step = scene.time_step_in_pose(person.pose_in(image), image.time or 0.0)
        render = scene.render(image.cameras, time_step, options=options, background=background)
        rendered = render.rgb[0]
        truth = image.composite(background)
        difference = rendered - truth
        masked = difference if image.mask is None else difference * image.mask[..., None]
        loss = image_loss(rendered, render.alpha[0], image, truth, config.train)
        total = total + (loss + SQUARED_WEIGHT * masked.square().mean()) / len(images)
    return total, rendered, truth
