"""Training of BG-Triangle (Wu et al. 2025): initialisation, densification, pruning, textures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from dyngs.baselines.triangles.kind import BgTriangleModel
from dyngs.baselines.triangles.scene import (
    CORNERS,
    FIRST_SCALE,
    SHAPE_SEGMENTS,
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
from dyngs.models.views import background_colour, evaluation_background, training_cameras
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.patches import NUM_POINTS, PatchSamples, lattice, lattice_size

MAX_INITIAL = 2000  # maximum initial triangles
RADIUS = 1.5  # radius of initial triangles, in mean distances to three neighbours
INNER = 0.02  # fraction of the points on either side that is ignored for the scene size
# Training of the Gaussians whose surface initialises the triangles.
LONGEST_SIDE = 160  # pixels; larger images are downscaled
MAX_GAUSSIANS = 20_000
VIEWS = 64  # Whose depths are fused
SURFACE_CELLS = 128  # Along the scene, at most; no more than pixels along an image


def _initialize_at_points(run: StartContext, model: BgTriangleModel) -> tuple[Patches, float]:
    """Create randomly oriented triangles at the initial points; return them and the scene's half
    side."""
    values = InitialValues(max_gaussians=min(MAX_INITIAL, model.max_triangles))
    first = initial_gaussians(run.capture, run.config.init, values, 0, run.generator)
    ends = first.means.quantile(torch.tensor([INNER, 1 - INNER], device="cpu"), dim=0)
    unit = float((ends[1] - ends[0]).max()) / 2
    if not unit > 0:
        raise DyngsError(
            f"{run.config.data.root}: all {len(first.means)} initial points coincide; "
            "set init.kind=random"
        )
    radius = first.log_scales.exp().amax(1).clamp(max=unit / 2) * RADIUS
    axes = torch.randn((len(first.means), 2, 3), generator=run.generator, device="cpu")
    one = torch.nn.functional.normalize(axes[:, 0], dim=1)
    other = torch.nn.functional.normalize(torch.linalg.cross(one, axes[:, 1]), dim=1)
    angles = torch.arange(3, device="cpu") * (2 * torch.pi / 3)
    triangles = angles.cos()[:, None] * one[:, None] + angles.sin()[:, None] * other[:, None]
    corners = first.means[:, None] + radius[:, None, None] * triangles
    colours = 0.5 + SH_C0 * first.sh[:, 0]
    return _flat_patches(corners, colours[:, None].repeat(1, 3, 1), model), unit


def _initialize_on_surface(run: StartContext, model: BgTriangleModel) -> tuple[Patches, float]:
    """Create triangles on the surface of trained Gaussians; return them and the scene's half side.

    Triangles occlude each other and get no gradient when hidden, so that random triangles block
    each other. Gaussians are transparent and can pass.

    Raises DyngsError if the Gaussians show no surface.
    """
    steps = model.gaussian_steps
    trained = _train_gaussians(run, steps)
    scene = replace(trained.scene, options=trained.options)
    seen = []
    with torch.no_grad():
        for index in evenly_spaced(len(run.images), VIEWS):
            image = _downscale(run.images[index])
            own = image.composite(torch.zeros(3, device="cpu"))
            seen.append(replace(render_depth_view(scene, image.cameras), colour=own))
    low, high = opaque_box(scene.gaussians)
    cells = min(SURFACE_CELLS, max(max(one.depth.shape) for one in seen))
    mesh = fuse_depths(seen, low, high, cells)
    mesh = None if mesh is None else simplify_mesh(mesh, min(MAX_INITIAL, model.max_triangles))
    if mesh is None or len(mesh.faces) == 0:
        raise DyngsError(
            f"{run.config.data.root}: no surface found after {steps} steps of Gaussian training; raise "
            "model.gaussian_steps, or set it to 0 to start at the initial points"
        )
    vertices = torch.from_numpy(mesh.vertices).float()
    faces = torch.from_numpy(mesh.faces)
    colours = sample_colours(seen, vertices, 2 * float((high - low).max()) / cells)
    corners = vertices[faces]
    ends = corners.flatten(0, 1)
    unit = float((ends.amax(0) - ends.amin(0)).max()) / 2
    return _flat_patches(corners, colours[faces], model), unit


def _train_gaussians(run: StartContext, steps: int) -> GaussianModel:
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
        image = _downscale(run.images[index])
        background = background_colour(run.background, run.generator)
        output = model.draw(image, step, background)
        rendered = output.rendering.rgb[0]
        truth = image.composite(background)
        l1_ssim_loss(rendered, truth, config.train.ssim_weight, image.mask).backward()
        output.after_backward()
        model.update(step)
    return model


def _downscale(image: Image) -> Image:
    return image.downscaled(-(-max(image.cameras.width, image.cameras.height) // LONGEST_SIDE))


def _flat_patches(corners: Tensor, colours: Tensor, model: BgTriangleModel) -> Patches:
    harmonics = torch.zeros((len(corners), num_sh_terms(model.sh_degree) - 1, 3), device="cpu")
    return Patches(flat_triangles(corners), flat_triangles(colours), harmonics)


CELLS = 6  # visibility cells along u and v of a triangle
MIN_EDGE = 0.2  # smaller image gradients are not edges


class TriangleStatistics:
    """Sums over training views since the last densification.

    Attributes:
        views: (1,) number of views.
        seen: (P,) views that show the triangle.
        edges: (P,) image gradients inside the triangle.
        gradients: (P,) gradient norms by its control points.
        cells: (P, 36) pixels that show each cell.
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
        """Accumulate a view whose image has gradient norms ``slopes`` (H, W)."""
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
        """Load statistics of ``count`` triangles from a state. Raises KeyError or ValueError."""
        found = TriangleStatistics(count)
        for name, x in found.tensors().items():
            x.copy_(require_tensor(name, stored[name], tuple(x.shape)))
        return found


@torch.no_grad()
def max_pixels(scene: TriangleScene, cameras: Iterable[Cameras]) -> Tensor:
    """Return the largest number of pixels (P,) of each triangle in any view of ``cameras``."""
    most = torch.zeros(len(scene), device="cpu")
    for camera in cameras:
        ids = scene.render_view(camera, scene.options)[1].ids.long()
        shown = torch.bincount(ids, minlength=len(scene)) / scene.options.supersampling**2
        most = torch.maximum(most, shown)
    return most


def near_outline(places: PatchSamples) -> Tensor:
    """Return a mask (N,) of samples within two rendered pixels of an outline, see
    ``blend_patches``."""
    rows = places.rows[0]
    render_view = rows >= 0
    ids = torch.full(rows.shape, -1, dtype=places.ids.dtype, device="cpu")
    ids[render_view] = places.ids[rows[render_view].long()]
    differs = torch.zeros(rows.shape, device="cpu")
    differs[:, :-1] += ids[:, 1:] != ids[:, :-1]
    differs[:-1] += ids[1:] != ids[:-1]
    return max_pool2d(differs[None, None], 3, 1, 1)[0, 0][render_view] > 0


def image_gradients(image: Tensor) -> Tensor:
    """Return mean gradient norms (H, W) of ``image`` (H, W, 3) by Prewitt's operator; small ones
    are 0."""
    padded = torch.nn.functional.pad(image.permute(2, 0, 1), (1, 1, 1, 1), mode="replicate")
    across = padded[:, :, 2:] - padded[:, :, :-2]
    down = padded[:, 2:] - padded[:, :-2]
    across = across[:, :-2] + across[:, 1:-1] + across[:, 2:]
    down = down[:, :, :-2] + down[:, :, 1:-1] + down[:, :, 2:]
    sizes = torch.hypot(across, down) / 3
    return torch.where(sizes < MIN_EDGE, 0.0, sizes).mean(0)


MIN_AREA, MIN_SPLIT_AREA = 1e-4, 2e-4  # areas, in squared half sides of the scene
MAX_ASPECT = 20.0  # aspect ratio of the bounding box of the corners
MIN_VIEW_FRACTION = 0.05  # fraction of the views that a triangle must be visible in
MIN_CELL_FRACTION = 8 / 36  # fraction of its cells that must be visible
# Mean pixels per view that a triangle must cover.
SLIVER = 0.5
ENLARGED = 1.1  # enlargement of children about their centres
CELLS_OF_TRIANGLE = CELLS * (CELLS + 1) // 2  # cells of the square that belong to the triangle


def patch_areas(points: Tensor) -> Tensor:
    """Return areas (P,) of the four flat triangles of each patch, world units squared."""
    places, faces = lattice(2)
    a, b, c = evaluate_patches(points, places)[:, faces].unbind(2)
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1).sum(1)


def prunable(points: Tensor, tallies: TriangleStatistics, unit: float) -> Tensor:
    """Return a mask (P,): rarely visible, tiny, needle-shaped, mostly hidden, or slivers."""
    corners = points[:, CORNERS]
    sides = (corners.amax(1) - corners.amin(1)).sort(1).values
    return (
        (tallies.seen / tallies.views.clamp_min(1) < MIN_VIEW_FRACTION)
        | (patch_areas(points) < MIN_AREA * unit**2)
        | (sides[:, 2] / sides[:, 1].clamp_min(1e-12) > MAX_ASPECT)
        | ((tallies.cells > 0).sum(1) < MIN_CELL_FRACTION * CELLS_OF_TRIANGLE)
        | (tallies.cells.sum(1) < SLIVER * tallies.seen)
        | ~points.isfinite().flatten(1).all(1)
    )


def densify(
    patches: Patches, tallies: TriangleStatistics, unit: float, most: int, rounds: int
) -> tuple[Tensor, dict[str, Tensor]]:
    """Plan pruning and splitting; return the kept rows (K,) and the rows to append by tensor name.

    The published thresholds depend on the image size. Here triangles are ranked by gradients plus
    edges, each relative to its mean, and split into four at an even rate towards ``most``.

    Args:
        unit: half side of the scene, world units.
        most: maximum number of triangles.
        rounds: remaining densifications, including this one.
    """
    points = patches.points.detach()
    gone = prunable(points, tallies, unit)
    if bool(gone.all()):
        gone = torch.zeros_like(gone)
    left = int((~gone).sum())
    wanted = -(-max(0, most - left) // (3 * max(1, rounds)))
    may = ~gone & (patch_areas(points) > MIN_SPLIT_AREA * unit**2)
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


INTERVAL, MIN_INTERVAL, LAST_DENSIFY = 300, 50, 18_000
"""Steps between densifications of a 30,000-step run, the minimum in any run, and the last of
30,000."""
# First and last learning rate of control points, in half sides of the scene.
POSITION_RATE, LAST_POSITION_RATE = 4e-3, 2e-4
COLOUR_RATE = 0.01
TEXTURE_FROM = 0.7  # fraction of the run after which textures are trained
HARMONICS_DIVISOR = 20.0  # divisor of the colour learning rate
# Learning rates of scales (log) and rotations of Gaussians while textures are trained
SCALE_RATE, ROTATION_RATE = 0.015, 1e-3
LAST_COLOUR = 0.1  # ratio of the last to the first colour learning rate of each phase
VALUE_BYTES = 1.3  # file size per value
MIN_TRIANGLES = 100  # fewest triangles that a size limit must allow
MIN_PIXELS = 1.0  # pixels that a triangle must cover in some training view


class TriangleTraining(Model[TriangleScene]):
    """Training of triangles: positions and colours first, textures later.

    Triangles are placed on the surface of trained Gaussians at the first step.

    Raises:
        DyngsError: the points coincide, or ``budget.max_mb`` is too small.
    """

    def __init__(self, run: StartContext) -> None:
        config = run.config
        self._run = run
        self._steps = config.train.steps
        model: Any = config.model
        self._model = model = _limit_triangles(model, config.budget.max_mb)
        self._awaits_surface = model.gaussian_steps > 0
        patches, unit = _initialize_at_points(run, model)
        behind = evaluation_background(config.data.background, run.capture.has_alpha)[1]
        options = scene_options(model, unit)
        self._scene = TriangleScene(patches, unit, options, behind, self._gaussian_scale(patches))
        self._begin(patches)

    def _begin(self, patches: Patches) -> None:
        """Train ``patches`` from now on, with zero moments and statistics."""
        self._learn(patches)
        self._adam = AdamState.zero(patches.tensors)

    def _learn(self, patches: Patches) -> None:
        leaves = {name: x.detach().requires_grad_() for name, x in patches.tensors.items()}
        self._scene = replace(self._scene, patches=replace(patches, **leaves))
        self._statistics = TriangleStatistics(len(patches))
        self._step_statistics = TriangleStatistics(len(patches))

    @property
    def scene(self) -> TriangleScene:
        return self._scene

    @property
    def options(self) -> TriangleOptions:
        """Render options."""
        return self._scene.options

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._scene.patches.tensors.values())

    @property
    def is_textured(self) -> bool:
        """True while textures are trained and the topology is fixed."""
        return self._scene.patches.texture > 0

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        if self._awaits_surface:
            self._awaits_surface = False
            patches, unit = _initialize_on_surface(self._run, self._model)
            options = scene_options(self._model, unit)
            scale = self._gaussian_scale(patches)
            self._scene = replace(self._scene, unit=unit, options=options, scale=scale)
            self._begin(patches)
        options = replace(self._scene.options, depth="expected" if depth else "none")
        rendering, places = self._scene.render_view(image.cameras, options, background)
        if not self.is_textured:
            self._step_statistics.count(places, image_gradients(image.composite(background)))
        return RenderOutput(rendering)

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [] if self.is_textured else list(self._step_statistics.tensors().values())

    def update(self, step: int) -> UpdateResult:
        patches = self._scene.patches
        grad = patches.points.grad
        if not self.is_textured and grad is not None:
            self._step_statistics.gradients += (
                grad.norm(dim=-1).sum(1) * self._step_statistics.views
            )
            self._statistics.add(self._step_statistics)
            self._step_statistics = TriangleStatistics(len(patches))
        rates = self._rates(step)
        updates = [self._adam.update(name, x, rates[name]) for name, x in patches.tensors.items()]
        bad = self._adam.steps_(updates, step=step)
        if step == self._steps:
            return self._finish(bad)
        if self.is_textured:
            return UpdateResult(bad)
        if self._first_texture <= step:
            if self._statistics.views >= MIN_INTERVAL:
                self._densify(0, 1)  # prune without splitting
            self._texture()
            count = len(self._scene)
            return UpdateResult(bad, f"training textures of {count:,} triangles", True)
        interval = max(MIN_INTERVAL, scale_step(INTERVAL, self._steps))
        last = min(scale_step(LAST_DENSIFY, self._steps), self._first_texture)
        if step % interval or step > last:
            return UpdateResult(bad)
        self._densify(self._model.max_triangles, 1 + (last - step) // interval)
        return UpdateResult(bad, topology_changed=True)

    @property
    def _first_texture(self) -> int:
        return round(TEXTURE_FROM * self._steps)

    def _rates(self, step: int) -> dict[str, float]:
        """Return the learning rate of each tensor at ``step``."""
        moved = step / self._steps
        position = self._scene.unit * POSITION_RATE ** (1 - moved) * LAST_POSITION_RATE**moved
        begun = self._first_texture if self.is_textured else 0
        end = self._steps if self.is_textured else self._first_texture
        colour = COLOUR_RATE * LAST_COLOUR ** min(1.0, max(0, step - begun) / max(1, end - begun))
        return {
            "points": position,
            "colours": colour,
            "harmonics": colour / HARMONICS_DIVISOR,
            "log_scales": colour / COLOUR_RATE * SCALE_RATE,
            "quats": colour / COLOUR_RATE * ROTATION_RATE,
        }

    def _texture(self) -> None:
        """Switch to textures; other tensors keep their moments."""
        before = self._adam
        patches = self._scene.patches.with_texture(self._model.texture)
        if self._model.primitives == "gaussians":
            patches = patches.with_shapes(FIRST_SCALE * self._scene.scale)
        self._begin(patches)
        for name in ("points", "harmonics"):
            self._adam.exp_avg[name] = before.exp_avg[name]
            self._adam.exp_avg_sq[name] = before.exp_avg_sq[name]

    def _gaussian_scale(self, patches: Patches) -> float:
        """Return the standard deviation of Gaussians before textures, world units."""
        centre = patches.points.detach().mean((0, 1))
        views = self._run.capture.splits["train"]
        pixels = [
            float((camera.centers[0] - centre).norm() / camera.intrinsics[0, 0, 0])
            for camera in training_cameras(views, self._run.config.data)
        ]
        return self._model.gaussian_size * median(pixels)

    def _finish(self, bad: Tensor | int) -> UpdateResult:
        """Prune triangles that no training view shows, after the last step."""
        images = self._run.images
        shown = max_pixels(self._scene, (images[i].cameras for i in range(len(images))))
        count = len(shown)
        stays = shown >= MIN_PIXELS
        if bool(stays.all()) or not bool(stays.any()):
            return UpdateResult(bad)
        none = {name: x.detach()[:0] for name, x in self._scene.patches.tensors.items()}
        self._replace_rows(stays.nonzero()[:, 0], none)
        gone = f"{count - len(self._scene):,} of {format_count(count, 'triangle')} are removed"
        return UpdateResult(
            bad, f"{gone}: no training view shows more than {MIN_PIXELS:g} px of them", True
        )

    def _densify(self, most: int, rounds: int) -> None:
        """Prune and split triangles, see ``densify``."""
        scene = self._scene
        self._replace_rows(*densify(scene.patches, self._statistics, scene.unit, most, rounds))

    def _replace_rows(self, kept: Tensor, added: Mapping[str, Tensor]) -> None:
        """Keep rows ``kept`` (K,) and append rows with zero moments."""
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
        kept = add_prefix("adam", self._adam.state()) | add_prefix(
            "tallies", self._statistics.state()
        )
        return self._scene.state() | kept

    def restore(self, checkpoint: Checkpoint) -> None:
        self._awaits_surface = False
        self._scene = restore_scene(self._model, checkpoint)
        patches = self._scene.patches
        self._learn(patches)
        self._adam = AdamState.from_state(checkpoint.part("adam"), patches.tensors)
        self._statistics = TriangleStatistics.from_state(checkpoint.part("tallies"), len(patches))

    def place(self, device: torch.device) -> None:
        if device.type != "cpu":
            raise DyngsError("model.kind=bg_triangle trains on the CPU only; set run.device=cpu")


def _limit_triangles(model: BgTriangleModel, megabytes: float | None) -> BgTriangleModel:
    """Limit the number of triangles to a file size in megabytes at the default precision."""
    if megabytes is None:
        return model
    values = 3 * (NUM_POINTS + lattice_size(model.texture) + num_sh_terms(model.sh_degree) - 1)
    if model.primitives == "gaussians":
        values += 7 * lattice_size(SHAPE_SEGMENTS)
    most = int(1e6 * megabytes / (VALUE_BYTES * values))
    if most < MIN_TRIANGLES:
        raise DyngsError(
            f"budget.max_mb={megabytes:g} is too small for {MIN_TRIANGLES} triangles; "
            f"{1e-6 * MIN_TRIANGLES * VALUE_BYTES * values * 1.05:.2g} would do"
        )
    return model.model_copy(update={"max_triangles": min(most, model.max_triangles)})
