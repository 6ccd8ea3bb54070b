"""Every op on the core for CUDA GPUs, which runs here over the emulation of its kernels, beside the
core for CPUs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from types import ModuleType

import pytest
import torch
from emulated_gpu import build_module, on_emulated_gpu
from scenes import Scene, random_scene
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops import native
from dyngs.ops.adam import adam_step_, seen_rows
from dyngs.ops.checks import count_nonfinite_op
from dyngs.ops.hash_grid import HashLevels, hash_features
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.nodes import HEAD_SIZES, node_penalties, spline_motion
from dyngs.ops.patches import (
    Places,
    blend_patches,
    outline_crossings,
    patch_values,
    visible_patches,
)
from dyngs.ops.perceptron import GPU_LAYERS, GPU_WIDTH, Layer, perceptron, perceptron_op
from dyngs.ops.planes import PlaneLevel, hexplane_features, plane_penalty
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.projection import project
from dyngs.ops.rasterization import BlendOptions, Tally, rasterize, tally
from dyngs.ops.rays import Rays, Space, Steps, composite, march, reached
from dyngs.ops.shading import Sight, shading_inputs
from dyngs.ops.skinning import add_offsets_, blend_skinning, offset_gradients

pytestmark = pytest.mark.usefixtures("one_thread")

Made = list[Tensor]


@pytest.fixture(scope="module")
def module(request: pytest.FixtureRequest) -> ModuleType:
    return build_module(request.config.cache.mkdir("emulated_gpu"))


@pytest.fixture
def gpu(module: ModuleType) -> Callable[[], object]:
    """A context in which ops run on the emulated GPU."""

    @contextmanager
    def use() -> Iterator[ModuleType]:
        with pytest.MonkeyPatch.context() as patch:
            on_emulated_gpu(patch, module)
            yield module

    return use


def single() -> Scene:
    return random_scene().to(torch.float32)


def drawn(gaussians: Gaussians) -> Made:
    """Images with depth, and the gradients by all that a render is differentiable in."""
    scene = single()
    leaves = {name: x.detach().clone().requires_grad_() for name, x in gaussians.tensors().items()}
    pose, intrinsics, background = (
        x.detach().clone().requires_grad_()
        for x in (scene.cam_from_world, scene.intrinsics, scene.background)
    )
    probe = torch.zeros(len(pose), len(gaussians), 4, requires_grad=True)
    rendering = render(
        Gaussians(**leaves),
        Cameras(pose, intrinsics, scene.width, scene.height),
        RenderOptions(depth="expected", absgrad=True, alpha_min=1e-3),
        background=background,
        probe=probe,
    )
    assert rendering.depth is not None
    weights = torch.rand(rendering.rgb.shape, generator=torch.Generator().manual_seed(1))
    loss = (
        (weights * rendering.rgb).sum()
        + (weights[..., 0] * rendering.depth).sum()
        + rendering.alpha.sum()
    )
    sources = [*leaves.values(), pose, intrinsics, background, probe]
    return [
        rendering.rgb,
        rendering.depth,
        rendering.alpha,
        rendering.radii,
        *torch.autograd.grad(loss, sources),
    ]


def tallied() -> Made:
    scene = single()
    projection = project(scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras)
    opacities = scene.opacities.expand(len(scene.cam_from_world), -1)
    colors = torch.rand(*opacities.shape, 3, generator=torch.Generator().manual_seed(0))
    return [
        tally(projection, opacities, scene.size, kind, colors=colors)
        for kind in Tally
        if kind != Tally.LANES
    ]


def compared() -> Made:
    """Losses of images with and without a mask, of SSIM alone, and their gradients."""
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.rand(20, 31, 3, generator=generator) for _ in range(2))
    mask = torch.rand(20, 31, generator=generator)
    found = []
    for weight, given in ((0.2, None), (0.2, mask), (1.0, None), (0.0, mask)):
        x.requires_grad_()
        loss = l1_ssim_loss(x, y, weight, given)
        found += [loss, *torch.autograd.grad(loss, x)]
    return [*found, l1_ssim_loss(x.detach(), y)]


def updated() -> Made:
    """Three steps of Adam on rows of which some are not asked for and some have no usable
    gradient."""
    generator = torch.Generator().manual_seed(0)
    param, grad = (torch.randn(40, 2, 3, generator=generator) for _ in range(2))
    grad[5, 1, 1] = float("nan")
    grad[7, 0, 0] = 1e30
    grad[9] = 0
    moments = torch.zeros_like(param), torch.zeros_like(param)
    rows = torch.rand(40, generator=generator) < 0.7
    rates = torch.linspace(0.01, 0.02, 6)
    skipped = [adam_step_(param, grad, *moments, lr=rates, step=step, rows=rows) for step in (1, 2)]
    skipped.append(adam_step_(param, grad, *moments, lr=0.01, step=3))
    return [
        param,
        *moments,
        torch.tensor(skipped),
        seen_rows(grad),
        count_nonfinite_op([grad, param]),
    ]


def moved() -> Made:
    tensors = [x.clone() for x in single().gaussians.tensors().values()]
    generator = torch.Generator().manual_seed(0)
    offsets = [
        0.1 * torch.randn(5, *shape, generator=generator) for shape in ((3,), (4,), (3,), (), (3,))
    ]
    add_offsets_(tensors, torch.tensor([3, 1, 0, 11, 7]), offsets)
    add_offsets_(tensors, None, (offsets[0], None, None, offsets[3], None))
    return tensors


def controlled() -> Made:
    """Nodes at a time and their penalties, with gradients by the splines; and those by offsets of
    rows."""
    generator = torch.Generator().manual_seed(0)
    heads: list[Tensor | None] = [
        torch.randn(6, 7, size, generator=generator).requires_grad_() for size in HEAD_SIZES
    ]
    leaves = [x for x in heads if x is not None]
    motion, values = spline_motion(heads, 0.4)
    near = torch.tensor([1, 2, 3, 4, 5, 0])[:, None]
    penalties = node_penalties(
        torch.randn(6, 3, generator=generator), torch.full((6,), 1.3), near, motion, leaves[0]
    )
    total = motion.square().sum() + values.square().sum() + penalties.sum()
    tensors = list(single().gaussians.tensors().values())
    grads, own = offset_gradients(tensors, torch.tensor([3, 1]), 2, tensors[1], torch.ones(2, 4))
    found = [x for x in (*grads, own) if x is not None]
    return [motion, values, penalties, *torch.autograd.grad(total, leaves), *found]


def shaded() -> Made:
    """Inputs of a colour network, of a body at rest with all that there is, and of a scene with the
    least."""
    scene = single()
    rows = torch.tensor([4, 0, 9])
    box = torch.tensor([[0.0, 0.1, 0.2], [1.0, 2.0, 3.0]])
    base = torch.rand(3, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    rest = (scene.means.flip(0), torch.eye(3).roll(1, 0))
    eye = torch.tensor([0.0, 0.0, -4.0])
    logs = scene.scales.log()
    full = Sight(scene.means, scene.quats, logs, rows, eye, box, rest, time=0.3)
    least = Sight(scene.means, scene.quats, logs, rows, eye, box, normals=False)
    found = [shading_inputs(each, base) for each in (full, least)]
    return [
        *found,
        *torch.autograd.grad(sum((x.square().sum() for x in found), torch.zeros(())), base),
    ]


def looked_up() -> Made:
    """Features of space-time grids and their penalty, with gradients by coordinates and planes."""
    generator = torch.Generator().manual_seed(0)
    planes = [
        (0.5 + torch.rand(3, rows, size, 8, generator=generator)).requires_grad_()
        for size in (4, 6)
        for rows in (size, 5)
    ]
    levels = [PlaneLevel(*planes[:2]), PlaneLevel(*planes[2:])]
    coords = (2.2 * torch.rand(50, 3, generator=generator) - 1.1).requires_grad_()
    features = hexplane_features(coords, 0.4, levels)
    penalty = plane_penalty(levels, (0.1, 0.2, 0.3))
    without = plane_penalty(
        [PlaneLevel(x.space.detach(), x.time.detach()) for x in levels], (0.1, 0.2, 0.3)
    )
    by_features = torch.autograd.grad(features.square().sum(), [coords, *planes])
    return [features, penalty, without, *by_features, *torch.autograd.grad(3 * penalty, planes)]


def skinned() -> Made:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(60, 3, generator=generator).requires_grad_()
    positions = torch.randn(9, 3, generator=generator)
    motion, values = (torch.randn(9, size, generator=generator).requires_grad_() for size in (7, 5))
    followed = torch.randint(9, (60, 4), generator=generator)
    offset, blended = blend_skinning(
        points, positions, torch.full((9,), 1.3), followed, motion, values
    )
    loss = offset.square().sum() + blended.sin().sum()
    return [offset, blended, *torch.autograd.grad(loss, [points, motion, values])]


def posed() -> Made:
    """Gaussians moved by joints, with gradients by everything, and by what is at rest alone."""
    generator = torch.Generator().manual_seed(0)
    rest = [torch.randn(70, size, generator=generator).requires_grad_() for size in (3, 4, 3)]
    weights = torch.rand(70, 5, generator=generator).softmax(1).requires_grad_()
    transforms = torch.randn(5, 3, 4, generator=generator).requires_grad_()
    found = pose_by_joints(*rest, weights, transforms)
    results = [found.means, found.quats, found.log_scales]
    loss = sum((x.sin().sum() for x in results), found.transforms.square().sum())
    alone = pose_by_joints(*rest, weights.detach(), transforms.detach()).log_scales.square().sum()
    by_all = torch.autograd.grad(loss, [*rest, weights, transforms])
    return [*results, found.transforms, *by_all, *torch.autograd.grad(alone, rest[1:])]


def decoded() -> Made:
    """Outputs of networks without and with a skip, and gradients with and without those by the
    rows."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for widths, skip in (((7, 3), None), ((7, 20, 33, 20, 5), 2)):
        ins = [w + (widths[0] if i == skip else 0) for i, w in enumerate(widths[:-1])]
        weights = [
            0.4 * torch.randn(b, a, generator=generator)
            for a, b in zip(ins, widths[1:], strict=True)
        ]
        biases = [0.4 * torch.randn(b, generator=generator) for b in widths[1:]]
        layers = [
            Layer(w.requires_grad_(), b.requires_grad_())
            for w, b in zip(weights, biases, strict=True)
        ]
        x = torch.randn(150, widths[0], generator=generator).requires_grad_()
        y = perceptron(x, layers, skip=skip)
        found += [y, *torch.autograd.grad(y.square().sum(), [x, *weights, *biases])]
        found += torch.autograd.grad(perceptron(x.detach(), layers, skip=skip).sin().sum(), weights)
        found.append(
            perceptron(
                x.detach()[:0],
                [Layer(v.weight.detach(), v.bias.detach()) for v in layers],
                skip=skip,
            )
        )
    return found


def seen_along() -> Made:
    """Samples of rays through occupied cells, their features in a hash grid, and what is seen, with
    gradients."""
    generator = torch.Generator().manual_seed(0)
    space = Space((0.1, 0.2, -0.1), 1.0, 2, 8)
    levels = HashLevels.geometric(3, 4, 24, 64)
    origins = 3 * torch.nn.functional.normalize(torch.randn(40, 3, generator=generator))
    aims = 0.6 * torch.randn(40, 3, generator=generator)
    occupied = torch.rand(space.shape, generator=generator) < 0.4
    rays = Rays(origins, torch.nn.functional.normalize(aims - origins))
    samples = march(
        rays, torch.rand(40, generator=generator), space, occupied, Steps(0.05, 0.05, 0.01)
    )
    table = torch.randn(levels.num_rows, 4, generator=generator).requires_grad_()
    features = hash_features(samples.coords, table, levels)
    densities = features[:, 0].exp()
    colours = features[:, 1:4].sigmoid()
    which, offsets = reached(densities, samples, 0.1)
    seen = composite(densities, colours, samples, 0.01)
    loss = seen.colour.square().sum() + seen.transmittance.square().sum() + seen.depth.sum()
    arrays = [
        samples.offsets,
        samples.rays,
        samples.starts,
        samples.ends,
        samples.coords,
        which,
        offsets,
    ]
    found = [seen.colour, seen.transmittance, seen.depth, seen.weights]
    return [*arrays, features, *found, *torch.autograd.grad(loss, table)]


def curved() -> Made:
    """Two views of bent triangles, with gradients by control points and colours."""
    generator = torch.Generator().manual_seed(0)
    points = (
        torch.rand(6, 1, 3, generator=generator)
        - 0.5
        + 0.3 * torch.randn(6, 6, 3, generator=generator)
    ).requires_grad_()
    colours = torch.rand(6, 6, 3, generator=generator).requires_grad_()
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[:, 2, 3], pose[1, 0, 3] = 3.0, 0.2
    inner = torch.tensor([[25.0, 0, 12], [0, 25, 10], [0, 0, 1]]).repeat(2, 1, 1)
    cameras = Cameras(pose, inner, 24, 20)
    places = Places.of(*visible_patches(points, cameras, 0.2))
    shown = patch_values(colours, places.ids, places.uv)
    crossings = outline_crossings(points, cameras, places)
    at = patch_values(points, places.ids, places.uv)
    image, through = blend_patches(at[:, :2].contiguous(), shown, crossings, places)
    loss = image.square().sum() + (through * crossings[:, 0]).sum()
    return [places.ids, crossings, image, through, *torch.autograd.grad(loss, [points, colours])]


CASES: dict[str, Callable[[], Made]] = {
    "render": lambda: drawn(single().gaussians),
    "tally": tallied,
    "loss": compared,
    "adam": updated,
    "offsets": moved,
    "nodes": controlled,
    "shading": shaded,
    "planes": looked_up,
    "skinning": skinned,
    "posing": posed,
    "perceptron": decoded,
    "field": seen_along,
    "triangles": curved,
}


@pytest.mark.parametrize("name", CASES)
def test_it_says_what_the_cpu_says(gpu: Callable, name: str) -> None:
    """Values and gradients, to float32: sums of some hundred numbers in another order."""
    expected = CASES[name]()
    with gpu():
        found = CASES[name]()
        again = CASES[name]()
    assert len(found) == len(expected)
    for i, (a, b, c) in enumerate(zip(found, expected, again, strict=True)):
        assert a.dtype == b.dtype
        scale = (
            float(b.detach().abs().nan_to_num().max())
            if b.is_floating_point() and b.numel()
            else 1.0
        )
        torch.testing.assert_close(
            a,
            b,
            rtol=1e-4,
            atol=2e-5 * max(scale, 1e-6),
            equal_nan=True,
            msg=lambda m, i=i: f"{name}, result {i}: {m}",
        )
        assert torch.equal(a.nan_to_num(), c.nan_to_num()), (
            f"{name}, result {i}: other bytes when repeated"
        )


def test_only_the_number_of_tile_entries_is_read_back(gpu: Callable) -> None:
    for name in CASES:
        with gpu() as module:
            before = module.host_reads()
            CASES[name]()
            reads = module.host_reads() - before
        assert reads == {"render": 1, "tally": 3}.get(name, 0), name


def test_lent_memory_is_new_wherever_other_arrays_lay_before(
    gpu: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torch lends memory of arrays that are gone; the emulation must not take it for theirs."""
    pool = torch.zeros(1 << 20, dtype=torch.uint8)
    with gpu() as module:
        monkeypatch.setattr(native, "lend", lambda size, _: pool[:size])
        expected = looked_up()
        for byte in range(8, 512, 8):
            module.note_memory(pool.data_ptr() + byte, 8, 8)
        for a, b in zip(looked_up(), expected, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_scenes_without_gaussians_and_images_without_splats(gpu: Callable) -> None:
    nothing = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    behind = single().gaussians
    behind = behind.replace(means=behind.means + torch.tensor([0.0, 0, -1000]))
    for gaussians in (nothing, behind):
        expected = drawn(gaussians)
        with gpu():
            found = drawn(gaussians)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b)


def test_too_many_tile_entries_are_refused_as_on_the_cpu(gpu: Callable) -> None:
    scene = single()
    projection = project(scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras)
    opacities = scene.opacities.expand(len(scene.cam_from_world), -1)
    colors = torch.zeros(*opacities.shape, 3)
    message = r"render refused: .* tiles, more than the limit of 3"

    def refused() -> str:
        with pytest.raises(DyngsError, match=message) as caught:
            rasterize(
                projection, opacities, colors, scene.size, options=BlendOptions(max_entries=3)
            )
        return str(caught.value)

    expected = refused()
    with gpu():
        assert refused() == expected


def test_the_limits_of_networks_are_those_of_the_kernel(gpu: Callable) -> None:
    def computed(*widths: int) -> Tensor:
        params = torch.zeros(sum((a + 1) * b for a, b in pairwise(widths)))
        return perceptron_op(torch.ones(1, widths[0]), params, list(widths), 0, False)[0]

    with gpu():
        assert computed(2, GPU_WIDTH, GPU_WIDTH, 1).tolist() == [[0.0]]
        assert computed(*[1] * (GPU_LAYERS + 1)).tolist() == [[0.0]]
        for widths in ([2, GPU_WIDTH + 1, 1], [GPU_WIDTH + 1, 1], [1] * (GPU_LAYERS + 2)):
            with pytest.raises(ValueError, match="up to 16 layers of up to 256 features"):
                computed(*widths)


def test_arrays_of_the_wrong_size_are_refused(gpu: Callable) -> None:
    with gpu() as module, pytest.raises(ValueError, match="count has 2 elements, expected 1"):
        module.count_nonfinite(
            native.array(torch.zeros(3)),
            native.array(torch.zeros(2, dtype=torch.int32)),
            native.num_threads(),
        )
