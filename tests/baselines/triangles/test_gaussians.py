"""Curved triangles rendered and trained as one Gaussian per pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import reference
import torch
import trimesh
from patch_reference import reference_values, reference_weights
from small_triangles import bent, camera, config_of, triangle
from torch import Tensor

from dyngs.api.train import train
from dyngs.baselines.triangles.kind import BgTriangleModel
from dyngs.baselines.triangles.scene import (
    BOUNDARY_RADIUS,
    FIRST_SCALE,
    OPACITY,
    SHAPE_SEGMENTS,
    Patches,
    TriangleOptions,
    TriangleScene,
    restore_scene,
)
from dyngs.cli import main
from dyngs.core.metrics import psnr
from dyngs.evaluate.report import evaluate_run
from dyngs.models.views import training_cameras
from dyngs.ops.native import kernel_threads
from dyngs.ops.patches import lattice, patch_values
from dyngs.ops.projection import ProjectionOptions
from dyngs.ops.rasterization import Boundaries
from dyngs.runs.checkpoint import checkpoint_paths, latest_checkpoint
from dyngs.runs.opened import open_run

KEYS = ["model.primitives=gaussians", "train.steps=112", "train.save_every=56"]
PLAIN = TriangleOptions(primitives="gaussians", boundary_weights=False)
WEIGHTED = TriangleOptions(primitives="gaussians")
RED = torch.tensor([0.8, 0.1, 0.2])


def doubled(patches: Patches) -> Patches:
    """With textures and random shapes, in float64, as leaves."""
    generator = torch.Generator().manual_seed(3)
    shaped = patches.with_texture(2).with_shapes(0.01)
    tensors = {name: x.double() for name, x in shaped.tensors.items()}
    for name in ("log_scales", "quats"):
        tensors[name] += 0.5 * torch.randn(tensors[name].shape, generator=generator).double()
    return replace(shaped, **{name: x.requires_grad_() for name, x in tensors.items()})


@pytest.mark.parametrize("options", [PLAIN, WEIGHTED])
def test_images_and_gradients_equal_reference(options: TriangleOptions) -> None:
    """Each step in plain torch in float64, from the patches that pixels show; before textures with
    weights, then without."""
    patches = doubled(bent(6, seed=2, degree=0))
    if options.boundary_weights:
        patches = replace(patches, log_scales=None, quats=None)
    view = camera(20).to(dtype=torch.float64)
    scene = TriangleScene(patches, 1.0, options, scale=0.08)
    found, places = scene.render_view(view, options)
    assert len(places.ids) > 80

    def textured(values: Tensor) -> Tensor:
        return patch_values(values, places.ids, places.uv, SHAPE_SEGMENTS)

    means = reference_values(patches.points, places.ids, places.uv)
    scales = torch.full_like(means, scene.scale)
    quats = torch.eye(4, dtype=torch.float64)[:1].expand(len(means), 4)
    if not options.boundary_weights:
        scales = textured(patches.tensors["log_scales"]).exp()
        quats = textured(patches.tensors["quats"])
    opacities = torch.full((len(means),), OPACITY, dtype=torch.float64)
    splats = reference.project(
        means,
        quats,
        scales,
        opacities,
        view,
        ProjectionOptions(near=options.near),
    )
    weights = None
    if options.boundary_weights:
        samples = splats.means2d[0]
        bounds = Boundaries(places.rows[0], places.ids, samples, BOUNDARY_RADIUS)
        weights = reference_weights(bounds)
    colours = textured(patches.colours).clamp_min(0)[None]
    expected = reference.rasterize(splats, opacities[None], colours, (20, 20), weights=weights)
    torch.testing.assert_close(found.rgb, expected.color)
    torch.testing.assert_close(found.transmittance, expected.transmittance)
    grad = torch.randn(found.rgb.shape, generator=torch.Generator().manual_seed(1)).double()
    leaves = {name: x for name, x in patches.tensors.items() if name != "harmonics"}
    own, wanted = (
        torch.autograd.grad(x, list(leaves.values()), grad) for x in (found.rgb, expected.color)
    )
    for name, one, other in zip(leaves, own, wanted, strict=True):
        assert other.abs().max() > 0, name
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-8)


def square() -> TriangleScene:
    """Two red triangles that cover pixels 6.4 to 25.6 of 32."""
    points = torch.cat(
        [
            triangle((-1, -1, 0), (1, -1, 0), (-1, 1, 0)),
            triangle((1, 1, 0), (1, -1, 0), (-1, 1, 0)),
        ]
    )
    colours = RED.expand(2, 6, 3).clone()
    return TriangleScene(Patches(points, colours, torch.zeros(2, 0, 3)), 1.0, WEIGHTED, scale=0.05)


def test_a_square_is_opaque_and_of_its_colour() -> None:
    options = replace(WEIGHTED, depth="expected")
    drawn = square().render(camera(), background=torch.ones(3), options=options)
    inside = slice(9, 13)  # away from the seam, where weights let the background through
    assert drawn.alpha[0, inside, inside].min() > 0.9
    assert (drawn.rgb[0, inside, inside] - RED).abs().max() < 0.1
    assert drawn.depth is not None
    torch.testing.assert_close(drawn.depth[0, inside, inside], torch.full((4, 4), 4.0))
    assert drawn.alpha[0, :3].max() == 0


def test_weights_sharpen_outlines() -> None:
    """Nothing is drawn two pixels outside of the square, where Gaussians alone still are."""
    weighted, alone = (square().render(camera(), options=x) for x in (WEIGHTED, PLAIN))
    assert weighted.alpha[0, 16, 4] == 0
    assert alone.alpha[0, 16, 4] > 0.01
    assert weighted.alpha[0, 16, 5] < alone.alpha[0, 16, 5]


def test_weights_end_where_textures_of_scales_begin() -> None:
    scene = square()
    textured = replace(scene, patches=scene.patches.with_shapes(scene.scale))
    weighted, alone = (textured.render(camera(), options=x) for x in (WEIGHTED, PLAIN))
    assert torch.equal(weighted.rgb, alone.rgb)
    assert not torch.equal(scene.render(camera()).rgb, alone.rgb)


def test_silhouettes_follow_their_gradient() -> None:
    """Towards an image of a larger square, with weights from samples of the outline alone."""
    scene = square()
    wide = replace(scene.patches, points=1.1 * scene.patches.points)
    target = replace(scene, patches=wide).render(camera()).rgb.detach()
    points = scene.patches.points.clone().requires_grad_()
    drawn = replace(scene, patches=replace(scene.patches, points=points)).render(camera())
    (slopes,) = torch.autograd.grad((drawn.rgb - target).square().sum(), points)
    outwards = (slopes * scene.patches.points)[:, [0, 3, 5], :2]
    assert (outwards.sum((1, 2)) < 0).all()


@pytest.mark.parametrize(("options", "least"), [(PLAIN, 0.9), (WEIGHTED, 0.7)])
def test_gradients_along_a_path_add_up_to_the_change_of_the_loss(
    options: TriangleOptions, least: float
) -> None:
    """Over three pixels: samples keep their places on patches in the gradient only, and samples of
    the outline lie at pixel centres, so that single gradients differ from those of the image."""
    scene = square()
    points = scene.patches.points.double()
    pixel = 4 / (32 * 1.2)
    step = torch.tensor([pixel, 0, 0], dtype=torch.float64)

    def drawn(moved: Tensor) -> Tensor:
        patches = Patches(points + moved * step, scene.patches.colours.double(), points[:, :0])
        at = replace(scene, patches=patches, scale=pixel)
        return at.render(camera().to(dtype=torch.float64), options=options).rgb

    target = drawn(torch.tensor(4.0))
    losses: list[Tensor] = []
    slopes: list[Tensor] = []
    for moved in torch.linspace(-1.5, 1.5, 31, dtype=torch.float64):
        leaf = moved.clone().requires_grad_()
        losses.append((drawn(leaf) - target).square().sum())
        slopes.extend(torch.autograd.grad(losses[-1], leaf))
    total = torch.trapezoid(torch.stack(slopes), dx=0.1)
    ratio = float(total / (losses[-1] - losses[0]).detach())
    assert least < ratio < 1.05


def test_an_empty_view_is_black() -> None:
    scene = square()
    behind = replace(scene.patches, points=scene.patches.points - torch.tensor([0, 0, 9.0]))
    drawn = replace(scene, patches=behind).render(camera())
    assert drawn.alpha.abs().max() == 0


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "gaussians"
    return train(config_of(capture, *KEYS, "model.gaussian_steps=300", f"run.dir={folder}"))


def test_training_learns_scales_and_rotations(run: Path) -> None:
    assert evaluate_run(run).psnr > 16
    scene = open_run(run).renderable
    assert isinstance(scene, TriangleScene)
    assert scene.options.primitives == "gaussians"
    patches = scene.patches
    assert patches.log_scales is not None
    assert patches.quats is not None
    assert patches.log_scales.shape == (len(patches), len(lattice(SHAPE_SEGMENTS)[0]), 3)
    first = torch.tensor(FIRST_SCALE * scene.scale).log()
    assert (patches.log_scales - first).abs().max() > 0.1
    assert patches.quats[..., 1:].abs().max() > 1e-3


@pytest.mark.parametrize("save_every", [56, 90])
def test_resume_equals_uninterrupted_run(capture: Path, tmp_path: Path, save_every: int) -> None:
    """Interrupted before and after scales and rotations are added (after step 78 of 112)."""
    keys = [*KEYS, f"train.save_every={save_every}", f"run.dir={tmp_path / 'run'}"]
    folder = train(config_of(capture, *keys))
    path = checkpoint_paths(folder)[-1]
    whole = path.read_bytes()
    path.unlink()
    assert main(["train", "--resume", str(folder)]) == 0
    assert path.read_bytes() == whole


def test_two_threads_give_the_same_bytes() -> None:
    def gradients(threads: int) -> list[Tensor]:
        tensors = {name: x.clone().requires_grad_() for name, x in bent(40).tensors.items()}
        scene = TriangleScene(replace(bent(40), **tensors), 1.0, WEIGHTED, scale=0.05)
        with kernel_threads(threads):
            drawn = scene.render(camera(64)).rgb
            return [drawn, *torch.autograd.grad(drawn.square().sum(), list(tensors.values()))]

    for one, other in zip(gradients(1), gradients(2), strict=True):
        assert torch.equal(one, other)


def test_stored_files_and_meshes(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "stored"
    assert main(["export", str(run), "--format", "dyngs", "--out", str(out)]) == 0
    opened = open_run(run)
    whole = opened.renderable
    stored = open_run(out).renderable
    view = training_cameras(opened.capture.splits["train"][:1], opened.config.data)[0]
    assert psnr(stored.render(view).rgb, whole.render(view).rgb) > 30
    mesh = tmp_path / "mesh.ply"
    assert main(["export", str(run), "--format", "mesh", "--out", str(mesh)]) == 0
    loaded = trimesh.load(mesh, force="mesh", process=False)
    assert isinstance(loaded, trimesh.Trimesh)
    assert len(loaded.faces) > 100


def test_mismatched_shapes_are_refused() -> None:
    stored = {name: x.tensor for name, x in bent(4).with_shapes(1.0).state().items()}
    assert Patches.from_state(stored).quats is not None
    with pytest.raises(ValueError, match="'quats'"):
        Patches.from_state(stored | {"quats": torch.zeros(4, 6, 3)})


def test_checkpoints_without_gaussians_open(run: Path) -> None:
    """Checkpoints that were written before Gaussians were added have none of their tensors."""
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None
    new = {f"triangles.{name}" for name in ("log_scales", "quats", "scale")}
    assert new <= set(checkpoint.tensors)
    tensors = {name: x for name, x in checkpoint.tensors.items() if name not in new}
    opened = restore_scene(BgTriangleModel(), replace(checkpoint, tensors=tensors))
    assert opened.options.primitives == "faces"
    assert opened.patches.log_scales is None
    assert set(opened.patches.tensors) == {"points", "colours", "harmonics"}
