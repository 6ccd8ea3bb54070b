"""The network over the atlas, a UNet on maps of observations in a few images (GHG, Kwon et al. 2024),
its training on captures of several people, and the avatar that it predicts of one.

Local letters: D input channels, K scaffolds, S texels per side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree
from torch import Tensor, nn

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.state import move_fields_to
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import RestPose
from dyngs.gaussians.scene import GaussianTimeStep, render_options
from dyngs.gaussians.schedule import RateSchedule
from dyngs.human.avatar.observations import FACING_EXPONENT, project_points
from dyngs.human.avatar.posing import BodyPose, Skeleton, pose_blend_shapes, texel_gaussians
from dyngs.human.avatar.scene import HumanScene, first_scene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import load_template
from dyngs.human.body.mesh import vertex_normals
from dyngs.human.fit.fitted_capture import ensure_fitted_body
from dyngs.human.keys import HumanModel, HumanPredictorModel
from dyngs.human.predict.gps.rectification import spread
from dyngs.human.predict.people import Person, captured_person, depths
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
    upsample,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU, select_device
from dyngs.ops.quaternions import quat_product, unit_quats


@dataclass(frozen=True)
class AtlasPerson:
    """A person with images on the atlas, as input of a prediction."""

    person: Person
    normals: Tensor  # (M, 3) unit normals of the vertices of the body
    texels: Texels  # P, of the person's shape
    mirror: Tensor  # (P,) index of the texel at the mirror image of each
    heights: tuple[float, ...]  # (K,) of the scaffolds, m, ascending
    scene: HumanScene  # K P grey discs, ordered by scaffold

    def observe(self, views: Sequence[int]) -> TexelMaps:
        """Return the maps of the images of some views."""
        shown = self.person.views
        poses = [self.person.pose_in(shown[i]) for i in views]
        images = (self.person.images[i] for i in views)
        return observe_texels(self, zip(images, poses, strict=True))


def atlas_person(person: Person, model: HumanPredictorModel) -> AtlasPerson:
    """Return a person on the atlas of ``model``."""
    body = person.body
    texels = atlas_texels(body, model.resolution, body.vertices)
    heights = tuple(sorted(set(model.scaffold_heights)))
    gaussians, anchors = texel_gaussians(texels, heights, 0)
    skeleton = Skeleton(body.joints, body.parents)
    normals = vertex_normals(body.vertices.double().cpu().numpy(), body.faces.cpu().numpy())
    return AtlasPerson(
        person=person,
        normals=torch.from_numpy(normals).to(body.vertices),
        texels=texels,
        mirror=mirror_texels(texels),
        heights=heights,
        scene=first_scene(
            gaussians, anchors, skeleton, person.motion.clip, pose_blend_shapes(body)
        ),
    )


def spread_views(person: AtlasPerson, count: int, first: int | None = None) -> list[int]:
    """Return the indices, ascending, of ``count`` views, evenly around the body: from the one that
    is most from the front on, or from the view ``first``.

    They are of one frame, that of ``first`` or the first with the most views, if it has enough;
    else of all frames. All views if there are fewer than ``count``.
    """
    shown = person.person.views
    frames = [view.frame for view in shown]
    frame = max(dict.fromkeys(frames), key=frames.count) if first is None else frames[first]
    allowed = [i for i, own in enumerate(frames) if own == frame]
    if len(allowed) < count:
        allowed = list(range(len(shown)))
    azimuths = {i: _azimuth(person, shown[i]) for i in allowed}
    ring = sorted(allowed, key=lambda i: azimuths[i])
    if first is None:
        first = min(ring, key=lambda i: abs(azimuths[i]))
    return sorted(set(spread(ring, count, ring.index(first))))


def _azimuth(person: AtlasPerson, view: View) -> float:
    """Return the angle of a camera around the vertical of the body at rest, rad; 0 is before it."""
    pose = person.person.pose_in(view)
    cam_from_world = torch.from_numpy(view.cam_from_world).to(pose.trans)
    center = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    pelvis = pose.scale * person.scene.skeleton.joints[0] + pose.trans
    x, _, z = pose.rotations[0].T @ (center - pelvis)
    return float(torch.atan2(x, z))


_NEAREST = 16  # seen texels that an unseen one takes its colour from
_TURN = 0.1  # metres that count as much as a turn of the normal by 60 degrees
_SOFT = 0.01  # distance added, m, so that the very nearest texel does not decide alone
_UNKNOWN = 0.5


def mirror_texels(texels: Texels) -> Tensor:
    """Return the index (P,) of the texel nearest to the mirror image of each one, at rest."""
    positions = _positions(texels)
    found = KDTree(positions).query(positions * np.array([-1.0, 1, 1, -1, 1, 1]))[1]
    return torch.from_numpy(np.asarray(found, dtype=np.int64)).to(texels.index.device)


def fill_unseen_colours(texels: Texels, rgb: Tensor, seen: Tensor) -> Tensor:
    """Return ``rgb`` (P, 3) where ``seen`` (P,) is positive, elsewhere the mean of seen texels that
    are near at rest.

    Weights fall with the squared distance, and grow with the cosine at which a texel is seen;
    normals count, too, so that the sole is not coloured like the instep. 0.5 if nothing is seen.
    """
    is_seen = (seen > 0).cpu().numpy()
    if not is_seen.any():
        return torch.full_like(rgb, _UNKNOWN)
    if is_seen.all():
        return rgb
    positions = _positions(texels)
    known = np.flatnonzero(is_seen)
    count = min(_NEAREST, len(known))
    found = KDTree(positions[known]).query(positions[~is_seen], k=count)
    # one neighbour comes without its axis
    distance, near = (np.asarray(x).reshape(-1, count) for x in found)
    rows = torch.from_numpy(known[near.astype(np.int64)]).to(rgb.device)
    weight = seen[rows] / (torch.from_numpy(distance).to(rgb) + _SOFT).square()
    filled = rgb.clone()
    filled[torch.from_numpy(~is_seen).to(rgb.device)] = (weight[..., None] * rgb[rows]).sum(
        1
    ) / weight.sum(1)[:, None]
    return filled


def _positions(texels: Texels) -> np.ndarray:
    """Return the positions and scaled normals (P, 6) of the texels at rest, m."""
    return torch.cat([texels.points, _TURN * texels.normals], dim=1).double().cpu().numpy()


_GRAZING = 0.15  # cosine below which a texel does not count as seen
MAX_SILHOUETTE_DISTANCE = (
    0.06  # largest distance from the edge of a silhouette that is told apart, m
)
# depth tolerance of the visibility test: in m, and in pixels along the surface
_TOLERANCE, _TOLERANCE_PX = 0.01, 1.5


@dataclass(frozen=True)
class TexelMaps:
    """Observations in a few images, per texel."""

    # (K, P, 3) mean colours, weighted towards frontal views; 0 where no view sees a texel
    rgb: Tensor
    # (K, P) largest cosine between normal and view direction, 0 where a texel is hidden
    seen: Tensor
    # (K, P) fraction of the views in whose silhouette a texel lies, of those that have it in the
    # frame
    inside: Tensor
    # (K, P) least signed distance over the views to the edge of the silhouette, positive inside, m
    # in the body's size, at most ``HULL_LIMIT`` and at least its negative
    silhouette_distance: Tensor
    # (P, 3) unit vectors from one scaffold to the next in the first view's pose, relative to the
    # pelvis
    offsets: Tensor
    # (P, 3) colours of the lowest scaffold, where it is not seen those of seen texels nearby
    nearby: Tensor
    count: int  # of the views


@torch.no_grad()
def observe_texels(person: AtlasPerson, images: Iterable[tuple[Image, BodyPose]]) -> TexelMaps:
    """Return the maps of at least one image, each with its body pose."""
    shape = (len(person.heights), len(person.texels))
    device = person.texels.points.device
    faces = person.person.body.faces.cpu().numpy()
    colour = torch.zeros(*shape, 3, device=device)
    weight, seen, inside, in_frames = (torch.zeros(shape, device=device) for _ in range(4))
    silhouette_distance = torch.full(shape, MAX_SILHOUETTE_DISTANCE, device=device)
    offsets: list[Tensor] = []
    for image, pose in images:
        camera = image.cameras
        focal = camera.intrinsics[0, 0, 0]
        scale = float(pose.scale)
        white = torch.ones_like(image.rgb_premultiplied[..., 0])
        alpha = white if image.alpha is None else image.alpha
        planes = [image.rgb_premultiplied, alpha[..., None], _edge_distances(image)[..., None]]
        scaffolds = [_posed_vertices(person, pose, height) for height in person.heights]
        normals = _at_texels(person, vertex_normals(scaffolds[0], faces))
        normals = torch.nn.functional.normalize(normals, dim=1)
        offsets.append(normals @ pose.rotations[0])
        for level, vertices in enumerate(scaffolds):
            world = _at_texels(person, vertices)
            at, depth, in_frame = project_points(world, camera)
            towards = torch.nn.functional.normalize(camera.centers[0] - world, dim=1)
            cosine = (towards * normals).sum(1)
            found = _sampled(torch.cat(planes, dim=-1), at) * in_frame[:, None]
            covered = found[:, 3]
            # On a slanted surface the pixels around a texel see nearer points, by their width over
            # the cosine.
            slack = scale * _TOLERANCE + _TOLERANCE_PX * depth / focal / cosine.clamp_min(_GRAZING)
            is_clear = depth <= _nearest_depth(vertices, faces, camera, at) + slack
            is_seen = is_clear & in_frame & (cosine > _GRAZING)
            cosine = torch.where(is_seen, cosine, 0.0) * (covered > 0.5)
            colour[level] += cosine[:, None] ** FACING_EXPONENT * found[:, :3]
            weight[level] += cosine**FACING_EXPONENT * covered
            seen[level] = torch.maximum(seen[level], cosine)
            inside[level] += (covered > 0.5).float()
            in_frames[level] += in_frame.float()
            # m of the body, within the frame
            to_edge = torch.where(
                in_frame, found[:, 4] * depth / focal / scale, MAX_SILHOUETTE_DISTANCE
            )
            silhouette_distance[level] = torch.minimum(silhouette_distance[level], to_edge)
    rgb = (colour / weight.clamp_min(1e-6)[..., None]).clamp(0, 1)
    fraction = torch.where(in_frames > 0, inside / in_frames.clamp_min(1), 1.0)
    nearby = fill_unseen_colours(person.texels, rgb[0], seen[0])
    return TexelMaps(
        rgb,
        seen,
        fraction,
        silhouette_distance.clamp_min(-MAX_SILHOUETTE_DISTANCE),
        offsets[0],
        nearby,
        len(offsets),
    )


def to_atlas(values: Tensor, texels: Texels) -> Tensor:
    """Return a map (D, S, S) of ``values`` (P, D) at the texels, 0 elsewhere."""
    atlas = values.new_zeros(values.shape[1], texels.resolution**2)
    atlas[:, texels.index] = values.T
    return atlas.unflatten(1, (texels.resolution, texels.resolution))


def from_atlas(atlas: Tensor, texels: Texels) -> Tensor:
    """Return the values (P, D) of a map (D, S, S) at the texels; differentiable."""
    return atlas.flatten(1).index_select(1, texels.index).T


def _edge_distances(image: Image) -> Tensor:
    """Return the signed distances (H, W) of pixels to the edge of the silhouette, positive inside,
    in pixels.

    Next to the edge they are the alpha less a half, which is exact for an upright edge.
    """
    if image.alpha is None:
        return torch.full_like(
            image.rgb_premultiplied[..., 0], float(max(image.rgb_premultiplied.shape))
        )
    alpha = image.alpha.double().cpu().numpy()
    is_inside = np.pad(alpha > 0.5, 1)
    within = np.asarray(distance_transform_edt(is_inside))[1:-1, 1:-1] - 0.5
    beyond = np.asarray(distance_transform_edt(~is_inside))[1:-1, 1:-1] - 0.5
    signed = np.where(alpha > 0.5, within, -beyond)
    signed = np.where(np.abs(signed) <= 0.5, alpha - 0.5, signed)
    return torch.from_numpy(signed).to(image.rgb_premultiplied)


def _nearest_depth(vertices: np.ndarray, faces: np.ndarray, camera: Cameras, at: Tensor) -> Tensor:
    """Return the least depth (P,) of a mesh in the four pixels around ``at`` (P, 2); infinite off
    the mesh."""
    depth = np.pad(depths(vertices, faces, camera).numpy(), 1, constant_values=np.inf)
    least = np.minimum.reduce([depth[:-1, :-1], depth[1:, :-1], depth[:-1, 1:], depth[1:, 1:]])
    column, row = (
        (at[:, i] + 0.5).floor().nan_to_num().clamp(0, size).long()
        for i, size in enumerate((camera.width, camera.height))
    )
    return torch.from_numpy(least)[row.cpu(), column.cpu()].to(at)


def _sampled(image: Tensor, at: Tensor) -> Tensor:
    """Return values (P, D) of an image (H, W, D) at columns and rows ``at`` (P, 2), bilinear
    between pixel centres."""
    size = at.new_tensor([image.shape[1], image.shape[0]])
    grid = (2 * at / size - 1).nan_to_num().clamp(-2, 2)[None, None]
    planes = image.permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(
        planes, grid, padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def _at_texels(person: AtlasPerson, values: np.ndarray) -> Tensor:
    """Return values (P, 3) at the texels, interpolated between those (M, 3) at the vertices."""
    corners = person.person.body.faces[person.texels.faces]
    around = torch.from_numpy(values).float().to(corners.device)[corners]
    return (person.texels.barycentric[..., None] * around).sum(1)


def _posed_vertices(person: AtlasPerson, pose: BodyPose, height: float) -> np.ndarray:
    """Return the vertices (M, 3) of a scaffold in the world."""
    vertices = person.person.body.vertices + height * person.normals
    posed, _ = person.person.posed(vertices, pose)
    return (pose.scale * posed + pose.trans).cpu().numpy()


WIDTHS = (24, 32, 48, 64)
"""Channels of the U-Net at 1/2, 1/4, ... of the resolution of the atlas."""
SILHOUETTE_FRACTION = 0.9
"""Gaussians above the lowest scaffold lie inside at least this fraction of the silhouettes."""
HEADS = {
    "rotation": 4,
    "scale": 3,
    "opacity": 1,
    "height": 1,
    "colour": 3,
    "image_weight": 1,
    "guess": 3,
}
"""Outputs per texel of a scaffold and their number of channels; see
``dyngs.human.predict.ghg.network``."""


class AtlasNetwork(Encoder):
    """UNet from maps (D, S, S) to raw predictions (K, 16, S, S) in the order of ``HEADS``, which
    are 0 before training.

    Each width halves the resolution; the way up concatenates the features of the way down, and at
    full resolution the input itself.
    """

    def __init__(self, channels: int, scaffolds: int, generator: torch.Generator) -> None:
        """D ``channels`` come in, K ``scaffolds`` go out.

        The network is made on the CPU, with weights of ``generator``.
        """
        with torch.device("cpu"):
            super().__init__(channels, WIDTHS)
            self.scaffolds = scaffolds
            self.up = nn.ModuleList(
                nn.Sequential(nn.Conv2d(below + width, width, 3, padding=1), ResidualBlock(width))
                for below, width in zip(WIDTHS[:0:-1], WIDTHS[-2::-1], strict=True)
            )
            self.last = nn.Sequential(
                nn.Conv2d(WIDTHS[0] + channels, WIDTHS[0], 3, padding=1), nn.SiLU()
            )
            self.heads = nn.Conv2d(WIDTHS[0], scaffolds * sum(HEADS.values()), 1)
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


_MAX_LOG_SCALE = 1.5  # limit on the difference of log scales from those of the initial Gaussian
# logit of the weight of the images' colours in an untrained network, against predicted colours
_IMAGE_LOGIT = 4.0
# logits of the fractions of the three guessed_colours in an untrained network
_GUESS_LOGITS = (0.0, 2.0, 0.0)
# limit on the offset along the normal with a single scaffold, m; with several: half their distance
_MAX_HEIGHT = 0.01


def num_input_channels(scaffolds: int) -> int:
    """Return the number of input channels D of a network for so many scaffolds."""
    return 6 * scaffolds + 18


def network_inputs(person: AtlasPerson, maps: TexelMaps, guesses: Tensor) -> Tensor:
    """Return the input (D, S, S): per scaffold colour, cosine, silhouettes; then offsets, points,
    and ``guesses`` (3, P, 3) of colours."""
    measured = torch.stack(
        [maps.seen, maps.inside, maps.silhouette_distance / MAX_SILHOUETTE_DISTANCE], dim=-1
    )
    scaffolds = torch.cat([maps.rgb, measured], dim=-1)
    ones = torch.ones(len(person.texels), 1, device=scaffolds.device)
    rest = [
        maps.offsets,
        person.texels.points,
        *guesses,
        maps.seen[0][person.mirror, None],
        ones,
        ones / maps.count,
    ]
    return to_atlas(torch.cat([*scaffolds, *rest], dim=1), person.texels)


def guess_unseen_colours(person: AtlasPerson, maps: TexelMaps, mean: Tensor) -> Tensor:
    """Return three guesses (3, P, 3) of the colours of texels that no image shows: the mean colours
    (3, S, S) of the training people, those of seen texels nearby, and those of the other side where
    it is seen, else as nearby."""
    is_seen = maps.seen[0][person.mirror, None] > 0
    mirrored = torch.where(is_seen, maps.rgb[0][person.mirror], maps.nearby)
    return torch.stack([from_atlas(mean, person.texels), maps.nearby, mirrored])


def predict_avatar(
    person: AtlasPerson, maps: TexelMaps, mean: Tensor, network: AtlasNetwork
) -> HumanScene:
    """Return the avatar that ``network`` predicts, differentiable in its weights.

    All texels of the lowest scaffold get a Gaussian; those above it where a view sees them and they
    lie inside the fraction ``SILHOUETTE_FRACTION`` of the silhouettes. Rotations are relative to
    the tangent frame, scales to the initial Gaussian, means move along the normal. Colours are a
    weighted mean of those of the images and of the network, which mixes and corrects the
    ``guessed_colours``. ``mean`` is as there.
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
    weight = weight * (maps.seen.flatten()[rows, None] > 0)
    fractions = (part["guess"] + part["guess"].new_tensor(_GUESS_LOGITS)).softmax(dim=1)
    guess = (fractions.T[..., None] * guesses[:, texel]).sum(0) + part["colour"]
    rgb = weight * maps.rgb.flatten(0, 1)[rows] + (1 - weight) * guess
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


VIEW_CHOICES_PER_PERSON = 6  # choices of source views per person in training; their maps are kept
TARGET_VIEWS = 2  # images of one time step that a prediction is compared with in each step
SQUARED_WEIGHT = 1.0  # Weight of the mean squared error in the loss, which counts edges more
MEAN_COLOUR_VIEWS = 8  # Images of each person that the mean colours are taken from
ADAPTATION_STEPS = 10  # Steps of training on the images of one person before a prediction
ADAPTATION_RATE = 1e-4
"""Highest learning rate of Adam per image of one person, which falls linearly: a single one says
little about the other sides."""
# Opacity below which a predicted Gaussian is left out, as the preset for one person has it
_FAINT = 0.02


class PersonPredictor(Predictor[AtlasNetwork]):
    """Predicts an avatar; ``adapt`` trains the network on images of the person before."""

    def __init__(
        self,
        config: Config,
        network: AtlasNetwork,
        mean: Tensor,
        person: AtlasPerson,
        data: DataConfig,
    ) -> None:
        """``mean`` (3, S, S) are colours of the people that the network was trained on."""
        super().__init__(config, network, person.person.views, data)
        self.mean = mean
        self._person = person

    def chosen(self, count: int) -> list[int]:
        return spread_views(self._person, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> HumanScene:
        scene = self._scene(self._person.observe(views))
        return scene.select(scene.gaussians.opacities >= _FAINT)

    def adapt(
        self,
        views: Sequence[int],
        steps: int | None = None,
        report: ProgressCallback = ignore_progress,
    ) -> int:
        """Train the network until its prediction shows the images better that it is predicted
        from."""
        steps = ADAPTATION_STEPS if steps is None else steps
        images = [self._person.person.images[i] for i in views]
        maps = self._person.observe(views)
        rate = ADAPTATION_RATE * len(views)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        for step in range(steps):
            scene = self._scene(maps)
            time_steps = [scene.time_step(image.time) for image in images]
            loss = _images_error(scene, time_steps, images, self.background, self.config)[0]
            if not optimizer_step(optimizer, self.network, loss, rate * (1.0 - step / steps)):
                break
            report("training on the images", step + 1, steps)
        return steps

    def run_config(self, views: Sequence[int]) -> Config:
        """Return the preset for one person, with the template of the network."""
        preset = load_config(packaged_preset("human"), ["data.root=."])
        same = ("body", "uv", "resolution", "near", "eps2d", "rasterize_mode", "sh_degree")
        given = human_options(self.section)
        human = preset.model.model_copy(update={name: getattr(given, name) for name in same})
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
    """Predicted from one choice of images, compared with others of one time step."""

    def __init__(
        self,
        config: Config,
        network: AtlasNetwork,
        people: list[AtlasPerson],
        source_choices: list[list[list[int]]],
        mean: Tensor,
        device: torch.device = CPU,
    ) -> None:
        """``choices`` are views to predict each person from; their maps are kept."""
        super().__init__(config, network, [x.person.name for x in people], device)
        self.people = people
        self.source_choices = source_choices
        self.mean = mean
        self._moved = [move_fields_to(x, device) for x in people]
        self._maps = cache(self._observed)

    def _observed(self, person: int, choice: int) -> TexelMaps:
        maps = self.people[person].observe(self.source_choices[person][choice])
        return move_fields_to(maps, self.device)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        filmed = self.people[person].person
        choice = random_index(len(self.source_choices[person]), generator)
        targets = self._targets(filmed, self.source_choices[person][choice], generator)
        background = self.sample_background(generator)
        maps = self._maps(person, choice)
        scene = predict_avatar(self._moved[person], maps, self.mean, self.network)
        row = filmed.motion.rows[-1 if targets[0].frame is None else targets[0].frame]
        gaussians, posing = scene.gaussians_in_frame(row, scene.template_weights())
        frame = RestPose(scene.gaussians.means, posing.rotations[0])
        moment = GaussianTimeStep(gaussians, targets[0].time, frame)
        loss, rendered, truth = _images_error(
            scene, [moment] * len(targets), targets, background, self.config
        )
        return Example(loss, targets[-1], rendered.detach(), truth, len(scene))

    def kept(self) -> dict[str, Tensor]:
        return {"mean": self.mean}

    def load(self, checkpoint: Checkpoint) -> None:
        mean = load_network(self.network, checkpoint, self.section.resolution)
        self.mean = mean.to(self.device)

    def _targets(
        self, person: Person, inputs: list[int], generator: torch.Generator
    ) -> list[Image]:
        """Return images of one time step that were not predicted from, where there are any."""
        views = person.views
        others = [i for i in range(len(views)) if i not in inputs] or inputs
        frame = views[others[random_index(len(others), generator)]].frame
        shown = [i for i in others if views[i].frame == frame]
        order = torch.randperm(len(shown), generator=generator, device="cpu").tolist()
        return [person.images[shown[i]].to(self.device) for i in order[:TARGET_VIEWS]]


def learner(config: Config, generator: torch.Generator) -> AtlasLearner:
    """Return the network of ``model.kind: human_predictor`` before the first step: captures read,
    nothing trained."""
    device = select_device(config.run.device)
    model: Any = config.model
    body = load_template(human_options(model))
    network = new_network(model, generator).to(device)
    people = [read_atlas_person(data, model, body) for data in list_captures(config.data)]
    source_choices = [_choices(person, model.source_views, generator) for person in people]
    mean = mean_colours(people, model.resolution).to(device)
    return AtlasLearner(config, network, people, source_choices, mean, device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    log: Callable[[str], None],
    report: ProgressCallback,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the person of ``data``; without body parameters a
    body is fitted.

    ``say`` and ``report`` receive the messages and the progress of that fit.
    """
    model: Any = config.model
    network = new_network(model, torch.Generator())
    mean = load_network(network, checkpoint, model.resolution)
    data = ensure_fitted_body(
        data, human_options(model), only_if_needed=True, log=log, report=report
    )
    person = read_atlas_person(data, model, load_template(human_options(model)))
    return PersonPredictor(config, network, mean, person, data)


def new_network(model: HumanPredictorModel, generator: torch.Generator) -> AtlasNetwork:
    """Return the untrained network of ``model``."""
    factor = 2 ** len(WIDTHS)
    if model.resolution % factor:
        raise DyngsError(f"model.resolution={model.resolution} must be a multiple of {factor}")
    scaffolds = len(set(model.scaffold_heights))
    return AtlasNetwork(num_input_channels(scaffolds), scaffolds, generator)


def load_network(network: AtlasNetwork, checkpoint: Checkpoint, resolution: int) -> Tensor:
    """Return the mean colours (3, S, S) of a checkpoint, whose weights ``network`` takes; S is the
    ``resolution``."""
    load_weights(network, checkpoint)
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        mean = checkpoint.tensors["model.mean"]
        return require_tensor("mean", mean, (3, resolution, resolution))


def human_options(model: HumanPredictorModel) -> HumanModel:
    """Return the section of one person with the same template and texels; nothing of it is
    learned."""
    shared = ("body", "uv", "resolution")
    drawn = ("near", "eps2d", "rasterize_mode", "alpha_min", "transmittance_min")
    return HumanModel.model_validate(
        {"sh_degree": 0, "refine": False} | {name: getattr(model, name) for name in shared + drawn}
    )


def read_atlas_person(
    data: DataConfig, model: HumanPredictorModel, body: BodyTemplate
) -> AtlasPerson:
    """Return the person of one capture."""
    capture = read_capture(data)
    images = ImageLoader(capture.splits["train"], data)
    return atlas_person(captured_person(capture, body, images), model)


def mean_colours(people: list[AtlasPerson], resolution: int) -> Tensor:
    """Return (3, S, S) mean over people of the colours that their images show of the lowest
    scaffold.

    Where nobody is seen: the mean of all that is.
    """
    total = torch.zeros(3, resolution, resolution, device="cpu")
    count = torch.zeros(1, resolution, resolution, device="cpu")
    for person in people:
        maps = person.observe(spread_views(person, MEAN_COLOUR_VIEWS))
        is_seen = (maps.seen[0] > 0).float()[:, None]
        total += to_atlas(maps.rgb[0] * is_seen, person.texels)
        count += to_atlas(is_seen, person.texels)
    overall = total.sum((1, 2)) / count.sum().clamp_min(1)
    return torch.where(count > 0, total / count.clamp_min(1), overall[:, None, None])


def _choices(person: AtlasPerson, source_views: int, generator: torch.Generator) -> list[list[int]]:
    """Return views to predict from, of a random time step each: one at random, the others chosen to
    see much.

    Every other choice has fewer than ``source_views``, in turn each number from 1.
    """
    firsts = torch.randint(
        len(person.person.views), (VIEW_CHOICES_PER_PERSON,), generator=generator, device="cpu"
    ).tolist()
    fewer = list(range(1, source_views)) or [source_views]
    counts = [
        fewer[i // 2 % len(fewer)] if i % 2 else source_views
        for i in range(VIEW_CHOICES_PER_PERSON)
    ]
    return [spread_views(person, count, first) for count, first in zip(counts, firsts, strict=True)]


def _images_error(
    scene: HumanScene,
    moments: Sequence[GaussianTimeStep],
    images: Sequence[Image],
    background: Tensor,
    config: Config,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean loss of renders of ``moments`` against images; the last render and its truth
    (H, W, 3)."""
    options = replace(render_options(config.model), nonfinite="trust")
    total = torch.zeros((), device=background.device)
    for image, moment in zip(images, moments, strict=True):
        drawn = scene.render(image.cameras, moment, options=options, background=background)
        rendered = drawn.rgb[0]
        truth = image.composite(background)
        difference = rendered - truth
        known = difference if image.mask is None else difference * image.mask[..., None]
        loss = image_loss(rendered, drawn.alpha[0], image, truth, config.train)
        total = total + (loss + SQUARED_WEIGHT * known.square().mean()) / len(images)
    return total, rendered, truth
