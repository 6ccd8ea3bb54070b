"""Curved triangles in training (Wu et al. 2025): the surface that they begin on, what images say
about each, which are split or removed, and at last textures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, max_pool2d

from dyngs.baselines.triangles.kind import BgTriangleModel
from dyngs.baselines.triangles.scene import (
    CORNERS,
    Patches,
    TriangleOptions,
    TriangleScene,
    evaluate_patches,
    flat_triangles,
    restore_scene,
    scene_options,
    subdivide,
)
from dyngs.config import DefaultStrategy, ShColour
from dyngs.config.kinds import section_of_kind
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError, format_count
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.training import ColourTraining
from dyngs.gaussians.initialization import (
    InitialValues,
    build_densifier,
    initial_gaussians,
    load_or_create_gaussians,
    scene_geometry,
)
from dyngs.gaussians.model import GaussianModel, SceneTraining
from dyngs.gaussians.optimizer import AdamState
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.surface import (
    fuse_depths,
    opaque_box,
    render_depth_view,
    sample_colours,
    simplify_mesh,
)
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Model, RenderOutput, UpdateResult
from dyngs.models.schedule import scale_step
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.patches import NUM_POINTS, PatchSamples, lattice, lattice_size

NUM_FIRST = 2000  # Triangles that a run begins with, at most
RADIUS = 1.5  # Of the first triangles, in mean distances of their points' three nearest neighbours
INNER = 0.02  # Fraction of the points on either side that does not count for the scene's size
# Gaussians whose surface triangles begin on
LONGEST_SIDE = 160  # Of the images that Gaussians learn, px
MAX_GAUSSIANS = 20_000
VIEWS = 64  # Whose depths are fused
SURFACE_CELLS = 128  # Along the scene, at most; no more than pixels along an image


def _at_points(run: StartContext, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles turned at random, and half the side of the scene."""
    values = InitialValues(max_gaussians=min(NUM_FIRST, model.max_triangles))
    first = initial_gaussians(
        scene_geometry(run.capture), run.config.init, values, 0, run.generator
    )
    ends = first.means.quantile(torch.tensor([INNER, 1 - INNER], device="cpu"), dim=0)
    unit = float((ends[1] - ends[0]).max()) / 2
    if not unit > 0:
        raise DyngsError(
            f"{run.config.data.root}: the {len(first.means)} first points are all in one place; "
            "give init.kind=random"
        )
    radius = first.log_scales.exp().amax(1).clamp(max=unit / 2) * RADIUS
    axes = torch.randn((len(first.means), 2, 3), generator=run.generator, device="cpu")
    one = torch.nn.functional.normalize(axes[:, 0], dim=1)
    other = torch.nn.functional.normalize(torch.linalg.cross(one, axes[:, 1]), dim=1)
    angles = torch.arange(3, device="cpu") * (2 * torch.pi / 3)
    triangles = angles.cos()[:, None] * one[:, None] + angles.sin()[:, None] * other[:, None]
    corners = first.means[:, None] + radius[:, None, None] * triangles
    colours = 0.5 + SH_C0 * first.sh[:, 0]
    return _flat(corners, colours[:, None].repeat(1, 3, 1), model), unit


def _on_surface(run: StartContext, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles on the surface of Gaussians, and half the side of the scene.

    Triangles cannot move through each other: what lies behind one gets no gradient, so that
    triangles at random stay where they are in each other's way. Gaussians are seen through.

    Raises DyngsError: what the Gaussians show is no surface.
    """
    steps = model.gaussian_steps
    trained = _trained_gaussians(run, steps)
    scene = replace(trained.scene, options=trained.options)
    seen = []
    with torch.no_grad():
        for index in evenly_spaced(len(run.images), VIEWS):
            image = _shrunk(run.images[index])
            own = image.composite(torch.zeros(3, device="cpu"))
            seen.append(replace(render_depth_view(scene, image.cameras), colour=own))
    low, high = opaque_box(scene.gaussians)
    cells = min(SURFACE_CELLS, max(max(one.depth.shape) for one in seen))
    mesh = fuse_depths(seen, low, high, cells)
    mesh = None if mesh is None else simplify_mesh(mesh, min(NUM_FIRST, model.max_triangles))
    if mesh is None or len(mesh.faces) == 0:
        raise DyngsError(
            f"{run.config.data.root}: {steps} steps of Gaussians show no surface for triangles to begin on: give more "
            "(model.gaussian_steps), or 0, to begin at points"
        )
    vertices = torch.from_numpy(mesh.vertices).float()
    faces = torch.from_numpy(mesh.faces)
    colours = sample_colours(seen, vertices, 2 * float((high - low).max()) / cells)
    corners = vertices[faces]
    ends = corners.flatten(0, 1)
    unit = float((ends.amax(0) - ends.amin(0)).max()) / 2
    return _flat(corners, colours[faces], model), unit


def _trained_gaussians(run: StartContext, steps: int) -> GaussianModel:
    config = run.config
    changed = {
        "model": section_of_kind("static").model_validate({"sh_degree": 0}),
        "strategy": DefaultStrategy(max_gaussians=MAX_GAUSSIANS),
        "train": config.train.model_copy(update={"steps": steps, "initial_downscale": 1}),
        "colour": ShColour(),
    }
    own = config.model_copy(update=changed)
    start = replace(run, config=own, uncapped=own)
    scene = StaticScene(gaussians=load_or_create_gaussians(start))
    colour = ColourTraining(ShColour())
    model = GaussianModel(start, scene, SceneTraining(), build_densifier(start), colour)
    order = torch.randint(len(run.images), (steps,), generator=run.generator, device="cpu")
    for step, index in enumerate(order.tolist(), 1):
        image = _shrunk(run.images[index])
        background = background_colour(run.background, run.generator)
        drawn = model.draw(image, step, background)
        rendered = drawn.rendering.rgb[0]
        truth = image.composite(background)
        l1_ssim_loss(rendered, truth, config.train.ssim_weight, image.mask).backward()
        drawn.after_backward()
        model.update(step)
    return model


def _shrunk(image: Image) -> Image:
    return image.shrunk(-(-max(image.cameras.width, image.cameras.height) // LONGEST_SIDE))


def _flat(corners: Tensor, colours: Tensor, model: BgTriangleModel) -> Patches:
    harmonics = torch.zeros((len(corners), num_sh_terms(model.sh_degree) - 1, 3), device="cpu")
    return Patches(flat_triangles(corners), flat_triangles(colours), harmonics)


CELLS = 6  # Cells along u and v of a triangle that were seen or not
FAINTEST_EDGE = 0.2  # Slopes of an image below this are no edges


class TriangleStatistics:
    """Sums over the views that were trained on since ``views`` was 0.

    Attributes:
        views: (1,) number of views.
        seen: (P,) views that show the triangle.
        edges: (P,) sum of the slopes of the images inside it.
        gradients: (P,) sum of the lengths of the gradients by its control points, over steps.
        cells: (P, 36) pixels of the images that showed each cell.
    """

    def __init__(self, count: int) -> None:
        self.views = torch.zeros(1, device="cpu")
        self.seen = torch.zeros(count, device="cpu")
        self.edges = torch.zeros(count, device="cpu")
        self.gradients = torch.zeros(count, device="cpu")
        self.cells = torch.zeros((count, CELLS**2), device="cpu")

    def tensors(self) -> dict[str, Tensor]:
        return dict(vars(self))

    def add(self, other: TriangleStatistics) -> None:
        for name, x in self.tensors().items():
            x += other.tensors()[name]

    def count(self, places: PatchSamples, slopes: Tensor) -> None:
        """Take in what a view shows, whose image has ``slopes`` (H, W)."""
        ids = places.ids.long()
        size = len(self.seen)
        shown = torch.bincount(ids, minlength=size)
        self.views += 1
        self.seen += (shown > 0).to(self.seen)
        scale = places.rows.shape[1] // slopes.shape[0]
        fine = interpolate(slopes[None, None], scale_factor=scale)[0, 0] / scale**2
        inside = fine[places.rows[0] >= 0] * ~near_outline(places)
        self.edges += torch.bincount(ids, weights=inside.double(), minlength=size).to(self.edges)
        u, v = (places.uv * (CELLS - 1)).long().clamp(0, CELLS - 1).unbind(1)
        cell = (ids * CELLS + u) * CELLS + v
        self.cells += (
            torch.bincount(cell, minlength=self.cells.numel()).view_as(self.cells) / scale**2
        )

    def state(self) -> State:
        return with_role(self.tensors(), Role.TRAINING)

    @staticmethod
    def from_state(stored: Mapping[str, Tensor], count: int) -> TriangleStatistics:
        """Return the tallies of ``count`` triangles in a state. Raises KeyError or ValueError."""
        found = TriangleStatistics(count)
        for name, x in found.tensors().items():
            x.copy_(require_tensor(name, stored[name], tuple(x.shape)))
        return found


@torch.no_grad()
def max_pixels(scene: TriangleScene, cameras: Iterable[Cameras]) -> Tensor:
    """Return (P,) the pixels that each triangle has in the view of ``cameras``, one each, that
    shows most of it."""
    most = torch.zeros(len(scene), device="cpu")
    for camera in cameras:
        ids = scene.drawn(camera, scene.options)[1].ids.long()
        shown = torch.bincount(ids, minlength=len(scene)) / scene.options.supersampling**2
        most = torch.maximum(most, shown)
    return most


def near_outline(places: PatchSamples) -> Tensor:
    """Return (N,) bool: which places lie within two drawn pixels of an outline, see
    ``blend_patches``."""
    rows = places.rows[0]
    drawn = rows >= 0
    ids = torch.full(rows.shape, -1, dtype=places.ids.dtype, device="cpu")
    ids[drawn] = places.ids[rows[drawn].long()]
    differs = torch.zeros(rows.shape, device="cpu")
    differs[:, :-1] += ids[:, 1:] != ids[:, :-1]
    differs[:-1] += ids[1:] != ids[:-1]
    return max_pool2d(differs[None, None], 3, 1, 1)[0, 0][drawn] > 0


def image_gradients(image: Tensor) -> Tensor:
    """Return (H, W): mean size of the slopes of ``image`` (H, W, 3) by Prewitt's operator; faint
    ones are 0."""
    across = torch.tensor([[-1.0, 0, 1]] * 3, device="cpu") / 3
    kernels = torch.stack([across, across.T])[:, None]
    channels = torch.nn.functional.pad(
        image.permute(2, 0, 1)[:, None], (1, 1, 1, 1), mode="replicate"
    )
    sizes = conv2d(channels, kernels).square().sum(1).sqrt()
    return torch.where(sizes < FAINTEST_EDGE, 0.0, sizes).mean(0)


SMALLEST, SMALLEST_SPLIT = 1e-4, 2e-4  # areas, in half sides of the scene squared
LONGEST = 20.0  # longest over middle side of the box around the corners
RARELY = 0.05  # fraction of the views below which a triangle is seen too rarely
HIDDEN = 8 / 36  # fraction of the cells below which it is mostly hidden
# px in the mean of the views that show a triangle, below which it is hidden but for a sliver
SLIVER = 0.5
ENLARGED = 1.1  # children, about their middles
CELLS_OF_TRIANGLE = CELLS * (CELLS + 1) // 2  # of the square's cells those that a triangle has


def patch_areas(points: Tensor) -> Tensor:
    """Return (P,) areas of the four flat triangles between corners and middles of the edges, world
    units squared."""
    places, faces = lattice(2)
    a, b, c = evaluate_patches(points, places)[:, faces].unbind(2)
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1).sum(1)


def prunable(points: Tensor, tallies: TriangleStatistics, unit: float) -> Tensor:
    """Return (P,) bool: rarely seen, tiny, needles, mostly hidden, or seen only as slivers between
    others."""
    corners = points[:, CORNERS]
    sides = (corners.amax(1) - corners.amin(1)).sort(1).values
    return (
        (tallies.seen / tallies.views.clamp_min(1) < RARELY)
        | (patch_areas(points) < SMALLEST * unit**2)
        | (sides[:, 2] / sides[:, 1].clamp_min(1e-12) > LONGEST)
        | ((tallies.cells > 0).sum(1) < HIDDEN * CELLS_OF_TRIANGLE)
        | (tallies.cells.sum(1) < SLIVER * tallies.seen)
        | ~points.isfinite().flatten(1).all(1)
    )


def densify(
    patches: Patches, tallies: TriangleStatistics, unit: float, most: int, rounds: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return (K,) the rows that stay, and the rows of each learned tensor that come after them.

    The published thresholds of gradients and edges depend on the images' size; here those that come
    first by both, each over its mean, are split into four, as many as lead evenly to the number
    that is wanted.

    Args:
        unit: half the side of the scene, world units.
        most: triangles that there may be.
        rounds: how often triangles are split from now on, this time included.
    """
    points = patches.points.detach()
    gone = prunable(points, tallies, unit)
    if bool(gone.all()):
        gone = torch.zeros_like(gone)
    left = int((~gone).sum())
    wanted = -(-max(0, most - left) // (3 * max(1, rounds)))
    may = ~gone & (patch_areas(points) > SMALLEST_SPLIT * unit**2)
    count = min(wanted, max(0, most - left) // 3, int(may.sum()))
    gradient = tallies.gradients / tallies.views.clamp_min(1)
    edges = tallies.edges / (tallies.seen + 1)
    gain = gradient / gradient.mean().clamp_min(1e-30) + edges / edges.mean().clamp_min(1e-30)
    score = torch.where(may, gain, -1.0)
    chosen = score.sort(descending=True, stable=True).indices[:count].sort().values
    gone[chosen] = True
    parts = subdivide(points[chosen])
    middles = parts.mean(1, keepdim=True)
    added = {
        "points": middles + ENLARGED * (parts - middles),
        "colours": subdivide(patches.colours.detach()[chosen]),
        "harmonics": patches.harmonics.detach()[chosen].repeat_interleave(4, 0),
    }
    return (~gone).nonzero()[:, 0], added


EVERY, LEAST_EVERY, UNTIL = 300, 50, 18_000
"""Steps between changes of a 30,000-step run, the fewest in any run, and after how many of 30,000
none is changed."""
# Learning rate of control points at first and at the end, in half sides of the scene
POSITION_RATE, LAST_POSITION_RATE = 4e-3, 2e-4
COLOUR_RATE = 0.01
TEXTURE_FROM = 0.7  # Fraction of the run after which textures are learned in place of colours
HARMONICS_SLOWER = 20.0  # than colours
LAST_COLOUR = 0.1  # Of their learning rate, at the end of each stage
VALUE_BYTES = 1.3  # In a file, per value of a triangle
FEWEST = 100  # Fewest triangles that a limit on the file must have room for
LEAST_SHOWN = 1.0  # px of some training view, of each triangle that stays


class TriangleTraining(Model[TriangleScene]):
    """Triangles in training: where they are and their colours first, textures after that.

    They lie at the first points of the capture until the first step, which puts them on the surface
    of Gaussians.

    Raises:
        DyngsError: the points are no scene, or ``budget.max_mb`` has no room.
    """

    def __init__(self, run: StartContext) -> None:
        config = run.config
        self._run = run
        self._steps = config.train.steps
        model: Any = config.model
        self._model = model = _within(model, config.budget.max_mb)
        self._awaits_surface = model.gaussian_steps > 0
        patches, unit = _at_points(run, model)
        behind = evaluation_background(config.data.background, run.capture.has_alpha)[1]
        self._scene = TriangleScene(patches, unit, scene_options(model, unit), behind)
        self._begin(patches)

    def _begin(self, patches: Patches) -> None:
        """Learn ``patches`` from now on, with empty moments and tallies."""
        self._learn(patches)
        self._adam = AdamState.zero(patches.tensors)

    def _learn(self, patches: Patches) -> None:
        leaves = {name: x.detach().requires_grad_() for name, x in patches.tensors.items()}
        self._scene = replace(self._scene, patches=replace(patches, **leaves))
        self._tallies = TriangleStatistics(len(patches))
        self._now = TriangleStatistics(len(patches))

    @property
    def scene(self) -> TriangleScene:
        return self._scene

    @property
    def options(self) -> TriangleOptions:
        """How it is drawn."""
        return self._scene.options

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._scene.patches.tensors.values())

    @property
    def is_textured(self) -> bool:
        """Whether textures are learned, and no triangle comes or goes."""
        return self._scene.patches.texture > 0

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        if self._awaits_surface:
            self._awaits_surface = False
            patches, unit = _on_surface(self._run, self._model)
            options = scene_options(self._model, unit)
            self._scene = replace(self._scene, unit=unit, options=options)
            self._begin(patches)
        options = replace(self._scene.options, depth="expected" if depth else "none")
        rendering, places = self._scene.drawn(image.cameras, options, background)
        if not self.is_textured:
            self._now.count(places, image_gradients(image.composite(background)))
        return RenderOutput(rendering)

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [] if self.is_textured else list(self._now.tensors().values())

    def update(self, step: int) -> UpdateResult:
        patches = self._scene.patches
        grad = patches.points.grad
        if not self.is_textured and grad is not None:
            self._now.gradients += grad.norm(dim=-1).sum(1) * self._now.views
            self._tallies.add(self._now)
            self._now = TriangleStatistics(len(patches))
        rates = self._rates(step)
        updates = [self._adam.update(name, x, rates[name]) for name, x in patches.tensors.items()]
        bad = self._adam.steps_(updates, step=step)
        if step == self._steps:
            return self._finished(bad)
        if self.is_textured:
            return UpdateResult(bad)
        if self._first_texture <= step:
            if self._tallies.views >= LEAST_EVERY:
                self._change(0, 1)  # what is useless goes, and nothing is split
            self._texture()
            count = len(self._scene)
            return UpdateResult(
                bad, f"textures are learned from now on, on {count:,} triangles", True
            )
        interval = max(LEAST_EVERY, scale_step(EVERY, self._steps))
        last = min(scale_step(UNTIL, self._steps), self._first_texture)
        if step % interval or step > last:
            return UpdateResult(bad)
        self._change(self._model.max_triangles, 1 + (last - step) // interval)
        return UpdateResult(bad, topology_changed=True)

    @property
    def _first_texture(self) -> int:
        return round(TEXTURE_FROM * self._steps)

    def _rates(self, step: int) -> dict[str, float]:
        """Return the learning rate of each tensor in ``step``."""
        moved = step / self._steps
        position = self._scene.unit * POSITION_RATE ** (1 - moved) * LAST_POSITION_RATE**moved
        begun = self._first_texture if self.is_textured else 0
        end = self._steps if self.is_textured else self._first_texture
        colour = COLOUR_RATE * LAST_COLOUR ** min(1.0, max(0, step - begun) / max(1, end - begun))
        return {"points": position, "colours": colour, "harmonics": colour / HARMONICS_SLOWER}

    def _texture(self) -> None:
        """Learn textures from now on, with the moments of what stays as it is."""
        before = self._adam
        self._begin(self._scene.patches.with_texture(self._model.texture))
        for name in ("points", "harmonics"):
            self._adam.exp_avg[name] = before.exp_avg[name]
            self._adam.exp_avg_sq[name] = before.exp_avg_sq[name]

    def _finished(self, bad: Tensor | int) -> UpdateResult:
        """Remove what no training view shows."""
        images = self._run.images
        shown = max_pixels(self._scene, (images[i].cameras for i in range(len(images))))
        count = len(shown)
        stays = shown >= LEAST_SHOWN
        if bool(stays.all()) or not bool(stays.any()):
            return UpdateResult(bad)
        none = {name: x.detach()[:0] for name, x in self._scene.patches.tensors.items()}
        self._exchange(stays.nonzero()[:, 0], none)
        gone = f"{count - len(self._scene):,} of {format_count(count, 'triangle')} are removed"
        return UpdateResult(
            bad, f"{gone}: no training view shows more than {LEAST_SHOWN:g} px of them", True
        )

    def _change(self, most: int, rounds: int) -> None:
        """Remove and split; see ``change``."""
        scene = self._scene
        self._exchange(*densify(scene.patches, self._tallies, scene.unit, most, rounds))

    def _exchange(self, kept: Tensor, added: Mapping[str, Tensor]) -> None:
        """Keep the rows ``kept`` (K,), and add others, whose moments are 0."""
        patches = self._scene.patches
        rows = {
            name: torch.cat([x.detach()[kept], added[name]]) for name, x in patches.tensors.items()
        }
        first, second = (
            {n: torch.cat([x[kept], torch.zeros_like(added[n])]) for n, x in moments.items()}
            for moments in (self._adam.exp_avg, self._adam.exp_avg_sq)
        )
        self._learn(replace(patches, **rows))
        self._adam = AdamState(first, second)

    def state(self) -> State:
        kept = add_prefix("adam", self._adam.state()) | add_prefix("tallies", self._tallies.state())
        return self._scene.state() | kept

    def restore(self, checkpoint: Checkpoint) -> None:
        self._awaits_surface = False
        self._scene = restore_scene(self._model, checkpoint)
        patches = self._scene.patches
        self._learn(patches)
        self._adam = AdamState.from_state(checkpoint.part("adam"), patches.tensors)
        self._tallies = TriangleStatistics.from_state(checkpoint.part("tallies"), len(patches))

    def place(self, device: torch.device) -> None:
        if device.type != "cpu":
            raise DyngsError("model.kind=bg_triangle is trained on the CPU: give run.device=cpu")


def _within(model: BgTriangleModel, megabytes: float | None) -> BgTriangleModel:
    """Return ``model`` with as many triangles as a file of so many 1e6 bytes holds at the usual
    precision."""
    if megabytes is None:
        return model
    values = 3 * (NUM_POINTS + lattice_size(model.texture) + num_sh_terms(model.sh_degree) - 1)
    most = int(1e6 * megabytes / (VALUE_BYTES * values))
    if most < FEWEST:
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: has no room for {FEWEST} triangles; "
            f"{1e-6 * FEWEST * VALUE_BYTES * values * 1.05:.2g} would do"
        )
    return model.model_copy(update={"max_triangles": min(most, model.max_triangles)})
