"""Example calls of every op, for the tests that all ops share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scenes import random_scene, weights
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.adam import adam_step_, seen_rows
from dyngs.ops.hash_grid import HashLevels, hash_features, select_features
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.nodes import HEAD_SIZES, node_penalties, spline_motion
from dyngs.ops.patches import (
    PatchSamples,
    blend_patches,
    outline_crossings,
    patch_values,
    visible_patches,
)
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.planes import PlaneLevel, hexplane_features, plane_penalty
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.projection import Projection, project
from dyngs.ops.rasterization import BlendOptions, Boundaries, Tally, rasterize, tally
from dyngs.ops.rays import MarchSteps, Rays, Space, composite, march, reached
from dyngs.ops.registration import count_nonfinite_op
from dyngs.ops.shading import shading_inputs
from dyngs.ops.skinning import add_offsets_, blend_skinning, offset_gradients
from dyngs.ops.slicing import condition_gaussians, harmonics_in_time, slice_gaussians


@dataclass(frozen=True)
class Case:
    """A function from leaf tensors to tensors, some of which depend on the leaves."""

    run: Callable[..., Sequence[Tensor]]
    inputs: tuple[Tensor, ...] = ()
    # of the last inputs, whose gradient is by intent not the derivative
    num_signals: int = 0

    def results(self) -> list[Tensor]:
        """Return the outputs, and the gradients of all inputs for a weighted sum of the outputs."""
        outputs = list(self.run(*self.inputs))
        if not self.inputs:
            return outputs
        terms = [(y * weights(y)).sum() for y in outputs if y.requires_grad]
        grads = torch.autograd.grad(torch.stack(terms).sum(), self.inputs)
        return [*(y.detach() for y in outputs), *grads]


class Numbers:
    """Reproducible random tensors of one dtype."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.generator = torch.Generator().manual_seed(0)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=torch.float64).to(self.dtype)

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, dtype=torch.float64).to(self.dtype)

    def below(self, high: int, *shape: int) -> Tensor:
        return torch.randint(high, shape, generator=self.generator)


def leaf(x: Tensor) -> Tensor:
    return x.detach().clone().requires_grad_()


def render_case(count: int, dtype: torch.dtype, *, alpha_min: float = 0.0) -> Case:
    """Images with depth of large Gaussians; the last input is the probe."""
    side = 5 if count < 10 else 36
    scene = random_scene(count, 2, (side + 1, side), degree=3 if count < 10 else 4).to(dtype)
    gaussians = scene.gaussians.replace(log_scales=(3 * scene.scales).log())
    options = RenderOptions(
        depth="expected", absgrad=True, alpha_min=alpha_min, transmittance_min=0, mode="antialiased"
    )

    def run(*x: Tensor) -> list[Tensor]:
        cameras = Cameras(x[5], x[6], scene.width, scene.height)
        image = render(Gaussians(*x[:5]), cameras, options, background=x[7], probe=x[8])
        assert image.depth is not None
        return [image.rgb, image.depth, image.alpha, image.radii]

    probe = torch.zeros(2, count, 4, dtype=dtype)
    tensors = [*gaussians.tensors().values(), scene.cam_from_world, scene.intrinsics]
    return Case(run, tuple(map(leaf, (*tensors, scene.background, probe))), num_signals=1)


def tally_case(count: int, dtype: torch.dtype) -> Case:
    scene = random_scene(count).to(dtype)
    projection = project(scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras)
    opacities = scene.opacities.expand(len(scene.cam_from_world), -1)
    colors = Numbers(dtype).uniform(*opacities.shape, 3)
    kinds = [kind for kind in Tally if kind != Tally.LANES]
    return Case(
        lambda: [tally(projection, opacities, scene.size, kind, colors=colors) for kind in kinds]
    )


def loss_case(count: int, dtype: torch.dtype) -> Case:
    """Losses with and without a mask, and SSIM alone."""
    numbers = Numbers(dtype)
    shape = 20 if count > 4 else count, 31 if count > 4 else count
    x, y = (numbers.uniform(*shape, 3) for _ in range(2))
    mask = numbers.uniform(*shape)
    kinds = ((0.2, None), (0.2, mask), (1.0, None), (0.0, mask))
    return Case(lambda x: [l1_ssim_loss(x, y, *kind) for kind in kinds], (leaf(x),))


def adam_case(count: int, dtype: torch.dtype) -> Case:
    """Three steps on rows, some of which are skipped or have non-finite gradients."""

    def run() -> list[Tensor]:
        numbers = Numbers(dtype)
        param = numbers.normal(count, 2, 3)
        grad = numbers.normal(count, 2, 3)
        grad[1, 1, 1] = float("nan")
        grad[2, 0, 0] = 1e30 if dtype == torch.float32 else float("inf")
        grad[3] = 0
        moments = torch.zeros_like(param), torch.zeros_like(param)
        rows = numbers.uniform(count) < 0.7
        rates = torch.linspace(0.01, 0.02, 6, dtype=dtype)
        skipped = [
            adam_step_(param, grad, *moments, lr=rates, step=step, rows=rows) for step in (1, 2)
        ]
        skipped.append(adam_step_(param, grad, *moments, lr=0.01, step=3))
        bad = count_nonfinite_op([grad.clamp_max(1e20), param])
        return [param, *moments, torch.stack(skipped), seen_rows(grad), bad]

    return Case(run)


def offsets_case(count: int, dtype: torch.dtype) -> Case:
    """Gaussians offset in place, and the gradients of their offsets."""

    def run() -> list[Tensor]:
        numbers = Numbers(dtype)
        tensors = list(random_scene(count).to(dtype).gaussians.tensors().values())
        moved = [x.clone() for x in tensors]
        offsets = [0.1 * numbers.normal(5, *shape) for shape in ((3,), (4,), (3,), (), (3,))]
        add_offsets_(moved, torch.tensor([3, 1, 0, 11, 7]), offsets)
        add_offsets_(moved, None, (offsets[0], None, None, offsets[3], None))
        turned = torch.ones(2, 4, dtype=dtype)
        grads, own = offset_gradients(tensors, torch.tensor([3, 1]), 2, tensors[1], turned)
        return [*moved, *(x for x in (*grads, own) if x is not None)]

    return Case(run)


def nodes_case(count: int, dtype: torch.dtype) -> Case:
    """Control nodes at one time, and their penalties."""
    numbers = Numbers(dtype)
    heads = [leaf(numbers.normal(count, 7, size)) for size in HEAD_SIZES]
    near = (torch.arange(count) + 1)[:, None] % count
    positions = numbers.normal(count, 3)
    radii = torch.full((count,), 1.3, dtype=dtype)

    def run(*heads: Tensor) -> list[Tensor]:
        motion, values = spline_motion(heads, 0.4)
        return [motion, values, node_penalties(positions, radii, near, motion, heads[0])]

    return Case(run, tuple(heads))


def shading_case(count: int, dtype: torch.dtype) -> Case:
    """Inputs of a colour network: of a posed body with all arguments, and of a minimal scene."""
    scene = random_scene(count + 10).to(dtype)
    rows = (3 * torch.arange(count)) % (count + 10)
    numbers = [[0.0, 0.1, 0.2], [1.0, 2.0, 3.0], [0.0, 0.0, -4.0]]
    *box, eye = torch.tensor(numbers, dtype=dtype)
    rest = scene.means.flip(0), torch.eye(3, dtype=dtype).roll(1, 0)
    seen = scene.means, scene.quats, scene.scales.log(), rows, eye, torch.stack(box)
    sights = (*seen, *rest, 0.3, True), (*seen, None, None, None, False)
    base = leaf(Numbers(dtype).uniform(count, 3))
    return Case(lambda base: [shading_inputs(base, *sight) for sight in sights], (base,))


def planes_case(count: int, dtype: torch.dtype) -> Case:
    """Features of space-time planes and their penalty."""
    numbers = Numbers(dtype)
    sizes = [(rows, size) for size in (4, 6) for rows in (size, 5)]
    planes = [leaf(0.5 + numbers.uniform(3, *size, 8 if count > 4 else 2)) for size in sizes]
    coords = leaf(2.2 * numbers.uniform(count, 3) - 1.1)

    def run(coords: Tensor, *planes: Tensor) -> list[Tensor]:
        levels = [PlaneLevel(*planes[:2]), PlaneLevel(*planes[2:])]
        return [hexplane_features(coords, 0.4, levels), plane_penalty(levels, (0.1, 0.2, 0.3))]

    return Case(run, (coords, *planes))


def skinning_case(count: int, dtype: torch.dtype) -> Case:
    """Points skinned by nodes. The points are the last input; skinning weights count as constant."""
    numbers = Numbers(dtype)
    points = leaf(numbers.normal(count, 3))
    positions = numbers.normal(9, 3)
    motion, values = (leaf(numbers.normal(9, size)) for size in (7, 5))
    followed = numbers.below(9, count, 4)
    radii = torch.full((9,), 1.3, dtype=dtype)

    def run(motion: Tensor, values: Tensor, points: Tensor) -> Sequence[Tensor]:
        return blend_skinning(points, positions, radii, followed, motion, values)

    return Case(run, (motion, values, points), num_signals=1)


def posing_case(count: int, dtype: torch.dtype) -> Case:
    numbers = Numbers(dtype)
    rest = [leaf(numbers.normal(count, size)) for size in (3, 4, 3)]
    weights = leaf(numbers.uniform(count, 5).softmax(1))
    transforms = leaf(numbers.normal(5, 3, 4))

    def run(*inputs: Tensor) -> list[Tensor]:
        return list(vars(pose_by_joints(*inputs)).values())

    return Case(run, (*rest, weights, transforms))


def slicing_case(count: int, dtype: torch.dtype) -> Case:
    """4D Gaussians at a time at which a few are not seen, and their shapes at all times."""
    numbers = Numbers(dtype)
    sizes = (3,), (), (4,), (4,), (3,), (), ()
    inputs = [leaf(numbers.normal(count, *size)) for size in sizes]
    colours = [leaf(numbers.normal(count, size, 3)) for size in (4, 8)]
    rows = torch.arange(count).flip(0)

    def run(*inputs: Tensor) -> list[Tensor]:
        sliced = slice_gaussians(*inputs[:7], time=0.3)
        elapsed = 0.3 - inputs[1]
        seen = sliced[3].detach() > -100
        colours = [harmonics_in_time(*inputs[7:], x, elapsed, seen) for x in (None, rows)]
        return [*sliced, *condition_gaussians(*inputs[2:6]), *colours]

    return Case(run, (*inputs, *colours))


def perceptron_case(count: int, dtype: torch.dtype, skip: int | None = 2) -> Case:
    numbers = Numbers(dtype)
    widths = (7, 20, 33, 20, 5) if count > 4 else (3, 4, 5, 2)
    inputs = [leaf(numbers.normal(count, widths[0]))]
    for i, width in enumerate(widths[1:]):
        fan_in = widths[i] + (widths[0] if i == skip else 0)
        inputs += [leaf(0.4 * numbers.normal(width, fan_in)), leaf(0.4 * numbers.normal(width))]

    def run(x: Tensor, *tensors: Tensor) -> list[Tensor]:
        layers = [Layer(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]
        return [perceptron(x, layers, skip=skip)]

    return Case(run, tuple(inputs))


def field_case(count: int, dtype: torch.dtype) -> Case:
    """Ray samples in occupied cells, their hash-grid features, and the composited colours."""
    numbers = Numbers(dtype)
    space = Space((0.1, 0.2, -0.1), 1.0, 2, 8)
    levels = HashLevels.geometric(3, 4, 24, 64)
    origins = 3 * torch.nn.functional.normalize(numbers.normal(count, 3))
    aims = 0.6 * numbers.normal(count, 3)
    occupied = numbers.uniform(*space.shape) < 0.4
    rays = Rays(origins, torch.nn.functional.normalize(aims - origins))
    shifts = numbers.uniform(count)

    def run(table: Tensor) -> list[Tensor]:
        samples = march(rays, shifts, space, occupied, MarchSteps(0.05, 0.05, 0.01))
        features = hash_features(samples.coords, table, levels)
        some = torch.arange(0, len(samples), 3)
        again = select_features(features.detach(), some, samples.coords[some], table, levels)
        densities = features[:, 0].exp()
        which, offsets = reached(densities, samples, 0.1)
        seen = composite(densities, features[:, 1:4].sigmoid(), samples, 0.0)
        return [*vars(samples).values(), which, offsets, features, again, *vars(seen).values()]

    return Case(run, (leaf(numbers.normal(levels.num_rows, 4)),))


def patches_case(count: int, dtype: torch.dtype) -> Case:
    """Two views of curved triangles; control point gradients come from moving outlines."""
    numbers = Numbers(dtype)
    points = leaf(numbers.uniform(count, 1, 3) - 0.5 + 0.3 * numbers.normal(count, 6, 3))
    colours = leaf(numbers.uniform(count, 6, 3))
    pose = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    pose[:, 2, 3] = 3.0
    pose[1, 0, 3] = 0.2
    inner = torch.tensor([[25.0, 0, 12], [0, 25, 10], [0, 0, 1]], dtype=dtype).repeat(2, 1, 1)
    cameras = Cameras(pose, inner, 24, 20)

    def run(colours: Tensor, points: Tensor) -> list[Tensor]:
        places = PatchSamples.of(*visible_patches(points, cameras, 0.2))
        shown = patch_values(colours, places.ids, places.uv)
        crossings = outline_crossings(points, cameras, places)
        at = patch_values(points, places.ids, places.uv)
        image, through = blend_patches(at[:, :2].contiguous(), shown, crossings, places)
        return [places.ids, crossings, image, through]

    return Case(run, (colours, points), num_signals=1)


def boundaries_case(count: int, dtype: torch.dtype) -> Case:
    """Gaussians of three patches, weighted by the distance to samples of their outlines."""
    numbers = Numbers(dtype)
    width, height = 21, 18
    pixels = numbers.uniform(height * width).argsort()[:count]
    rows = torch.full((height * width,), -1, dtype=torch.int32)
    rows[pixels.sort().values] = torch.arange(len(pixels), dtype=torch.int32)
    ids = numbers.below(3, count).int()
    depths = 1 + numbers.uniform(1, count)
    radii = torch.full((1, count, 2), 99, dtype=torch.int32)
    extent = torch.tensor([width, height], dtype=dtype)
    tilt = torch.tensor([0.4, 0.1, 0.5], dtype=dtype)
    inputs = [numbers.uniform(1, count, 2) * extent, tilt + 0.1 * numbers.uniform(1, count, 3)]
    inputs += [0.2 + 0.6 * numbers.uniform(1, count), numbers.uniform(1, count, 3)]
    inputs += [numbers.uniform(count, 2) * extent]
    options = BlendOptions(alpha_min=0, transmittance_min=0)

    def run(*x: Tensor) -> list[Tensor]:
        projection = Projection(x[0], depths, x[1], torch.ones_like(depths), radii)
        bounds = Boundaries(rows.view(height, width), ids, x[4], 2.5)
        found = rasterize(
            projection, x[2], x[3], (width, height), options=options, boundaries=bounds
        )
        return [found.color, found.transmittance]

    return Case(run, tuple(map(leaf, inputs)))


CASES: dict[str, Callable[[int, torch.dtype], Case]] = {
    "render": render_case,
    "tally": tally_case,
    "loss": loss_case,
    "adam": adam_case,
    "offsets": offsets_case,
    "nodes": nodes_case,
    "shading": shading_case,
    "planes": planes_case,
    "skinning": skinning_case,
    "posing": posing_case,
    "slicing": slicing_case,
    "perceptron": perceptron_case,
    "field": field_case,
    "patches": patches_case,
    "boundaries": boundaries_case,
}
ON_GPU = [name for name in CASES if name != "boundaries"]
