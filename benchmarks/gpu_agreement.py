"""How far a CUDA GPU is from the CPU, op by op: the largest difference over the largest value,
values and gradients.

    python benchmarks/gpu_agreement.py

On a GPU that can be used; without one on the emulation of tests/, which needs a C++ compiler and
nanobind. Inputs are the same float32 numbers everywhere. Beside the GPU's distance from the CPU's
float64 stands that of the CPU's float32.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.adam import adam_step_
from dyngs.ops.device import gpu_unavailable_reason
from dyngs.ops.hash_grid import HashLevels, hash_features
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.planes import PlaneLevel, hexplane_features, plane_penalty
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.rays import Samples, composite
from dyngs.ops.skinning import blend_skinning
from dyngs.ops.slicing import slice_gaussians

COUNT, SIDE = 3000, 96
Given = dict[str, Tensor]
Found = dict[str, Tensor]


def numbers(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    """Normally distributed float32."""
    return scale * torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def with_gradients(given: Given, outputs: Found) -> Found:
    """``outputs`` and the gradients by ``given`` of their sum with fixed random weights."""
    leaves = {name: x for name, x in given.items() if x.requires_grad}
    terms = [
        (numbers(*x.shape, seed=7).to(x) * x).sum() for x in outputs.values() if x.requires_grad
    ]
    gradients = torch.autograd.grad(sum(terms[1:], terms[0]), list(leaves.values()))
    return outputs | {f"by {name}": x for name, x in zip(leaves, gradients, strict=True)}


def scene() -> Given:
    """Gaussians before one camera."""
    means = numbers(COUNT, 3) * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.0, 0.0, 4.0])
    trained = {
        "means": means,
        "quats": numbers(COUNT, 4, seed=1),
        "log_scales": numbers(COUNT, 3, seed=2, scale=0.4) - 3.0,
        "logit_opacities": numbers(COUNT, seed=3),
        "sh": numbers(COUNT, 9, 3, seed=4, scale=0.3),
    }
    lens = torch.tensor([[1.2 * SIDE, 0.0, SIDE / 2], [0.0, 1.2 * SIDE, SIDE / 2], [0.0, 0.0, 1.0]])
    return {name: x.requires_grad_() for name, x in trained.items()} | {
        "pose": torch.eye(4)[None],
        "lens": lens[None],
    }


def drawn(given: Given) -> Found:
    """An image with depth; no threshold that rounding could cross."""
    gaussians = Gaussians(**{name: x for name, x in given.items() if name not in ("pose", "lens")})
    options = RenderOptions(depth="expected", alpha_min=1e-6, transmittance_min=1e-6)
    made = render(gaussians, Cameras(given["pose"], given["lens"], SIDE, SIDE), options)
    assert made.depth is not None
    return with_gradients(given, {"colours": made.rgb, "alpha": made.alpha, "depth": made.depth})


def compared(given: Given) -> Found:
    """L1 and SSIM of two images."""
    return with_gradients(given, {"loss": l1_ssim_loss(given["image"], given["truth"], 0.2)})


def updated(given: Given) -> Found:
    """One parameter after ten steps of Adam."""
    x = given["x"].clone()
    first = torch.zeros_like(given["x"])
    second = torch.zeros_like(given["x"])
    for step in range(1, 11):
        adam_step_(x, given["gradient"] * step, first, second, lr=0.01, step=step)
    return {"parameter": x, "moment": first}


def looked_up(given: Given) -> Found:
    """Features of space-time grids, and their penalty."""
    levels = [PlaneLevel(given["space"], given["time"])]
    features = hexplane_features(given["places"], 0.4, levels)
    penalty = plane_penalty(levels, (0.1, 0.2, 0.3))
    return with_gradients(given, {"features": features, "penalty": penalty})


def skinned(given: Given) -> Found:
    """Points that follow control nodes."""
    arguments = (
        given[name] for name in ("points", "nodes", "radii", "followed", "motion", "values")
    )
    offsets, blended = blend_skinning(*arguments)
    return with_gradients(given, {"offsets": offsets, "values": blended})


def posed(given: Given) -> Found:
    """Gaussians that follow joints; axes as covariances, which no order of axes changes."""
    made = pose_by_joints(
        *(given[name] for name in ("means", "quats", "log_scales", "weights", "transforms"))
    )
    axes = rotation_matrices(made.quats) * made.log_scales.exp()[:, None, :]
    return with_gradients(given, {"means": made.means, "covariances": axes @ axes.mT})


def sliced(given: Given) -> Found:
    """4D Gaussians at a time; axes as in ``posed``."""
    means, quats, log_scales, logits = slice_gaussians(**given, time=0.3, min_weight=0)
    axes = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return with_gradients(given, {"means": means, "covariances": axes @ axes.mT, "logits": logits})


def decoded(given: Given) -> Found:
    """A network whose third layer sees the features once more."""
    layers = [Layer(given[f"weight{i}"], given[f"bias{i}"]) for i in range(4)]
    return with_gradients(given, {"outputs": perceptron(given["features"], layers, skip=2)})


def hashed(given: Given) -> Found:
    """Features of a hash grid of eight levels."""
    levels = HashLevels.geometric(8, 16, 256, 1 << 14)
    return with_gradients(
        given, {"features": hash_features(given["places"], given["table"], levels)}
    )


def composited(given: Given) -> Found:
    """Rays of 30 samples each."""
    starts = given["starts"]
    count = torch.arange(COUNT // 30 + 1, device=given["starts"].device)
    samples = Samples(
        30 * count,
        count[:-1].repeat_interleave(30).int(),
        starts,
        starts + 0.05,
        starts[:, None].repeat(1, 3),
    )
    seen = composite(given["log_densities"].exp(), given["colours"], samples, 1e-6)
    return with_gradients(
        given, {"colours": seen.colour, "transmittance": seen.transmittance, "depth": seen.depth}
    )


def network() -> Given:
    """Features, and the weights of 40-64-64-64-10."""
    given = {"features": numbers(COUNT, 40).requires_grad_()}
    for i, (width, inputs) in enumerate(((64, 40), (64, 64), (64, 104), (10, 64))):
        given[f"weight{i}"] = numbers(
            width, inputs, seed=i, scale=(2 / inputs) ** 0.5
        ).requires_grad_()
        given[f"bias{i}"] = numbers(width, seed=4 + i, scale=0.1).requires_grad_()
    return given


def cases() -> dict[str, tuple[Callable[[Given], Found], Given]]:
    """What is computed, of what, by name."""
    trained = torch.Tensor.requires_grad_
    images = [numbers(SIDE, SIDE, 3, seed=i).sigmoid() for i in range(2)]
    motion = torch.cat(
        [numbers(50, 3, seed=5, scale=0.1), numbers(50, 4, seed=6) + torch.tensor([4.0, 0, 0, 0])],
        1,
    )
    transforms = torch.cat(
        [torch.eye(3).expand(24, 3, 3) + numbers(24, 3, 3, scale=0.2), numbers(24, 3, 1)], 2
    )
    return {
        "render": (drawn, scene()),
        "loss": (compared, {"image": trained(images[0]), "truth": images[1]}),
        "Adam": (updated, {"x": numbers(COUNT, 3), "gradient": numbers(COUNT, 3, seed=1)}),
        "grids": (
            looked_up,
            {
                "places": trained(numbers(COUNT, 3, scale=0.5)),
                "space": trained(1 + numbers(3, 16, 16, 8, seed=1, scale=0.1)),
                "time": trained(1 + numbers(3, 9, 16, 8, seed=2, scale=0.1)),
            },
        ),
        "control nodes": (
            skinned,
            {
                "points": trained(numbers(COUNT, 3)),
                "nodes": numbers(50, 3, seed=1),
                "radii": torch.full((50,), 0.7),
                "followed": torch.randint(50, (COUNT, 4), generator=torch.Generator().manual_seed(2)),
                "motion": trained(motion),
                "values": trained(numbers(50, 5, seed=3)),
            },
        ),
        "joints": (
            posed,
            {
                "means": trained(numbers(COUNT, 3)),
                "quats": trained(numbers(COUNT, 4, seed=1)),
                "log_scales": trained(numbers(COUNT, 3, seed=2, scale=0.5)),
                "weights": (4 * numbers(COUNT, 24, seed=3)).softmax(1),
                "transforms": trained(transforms),
            },
        ),
        "4D Gaussians": (
            sliced,
            {
                "means": trained(numbers(COUNT, 3)),
                "times": trained(numbers(COUNT, seed=1)),
                "quats": trained(numbers(COUNT, 4, seed=2)),
                "right_quats": trained(numbers(COUNT, 4, seed=3)),
                "log_scales": trained(numbers(COUNT, 3, seed=4, scale=0.5)),
                "log_spans": trained(numbers(COUNT, seed=5, scale=0.5)),
                "logit_opacities": trained(numbers(COUNT, seed=6)),
            },
        ),
        "network": (decoded, network()),
        "hash grid": (
            hashed,
            {
                "places": numbers(COUNT, 3).sigmoid(),
                "table": trained(numbers(sum(HashLevels.geometric(8, 16, 256, 1 << 14).rows), 4, seed=1)),
            },
        ),
        "rays": (
            composited,
            {
                "starts": 2 + 0.05 * torch.arange(30).repeat(COUNT // 30),
                "log_densities": trained(numbers(COUNT)),
                "colours": trained(numbers(COUNT, 3, seed=1).sigmoid()),
            },
        ),
    }  # fmt: skip


def on(given: Given, device: str, dtype: torch.dtype) -> Given:
    """The same numbers elsewhere, as leaves where they are."""
    return {
        name: x.detach()
        .to(device, dtype if x.is_floating_point() else None)
        .requires_grad_(x.requires_grad)
        for name, x in given.items()
    }


def distance(found: Tensor, wanted: Tensor) -> float:
    """The largest difference over the largest value."""
    wanted = wanted.detach().double()
    return float(
        (found.detach().double().cpu() - wanted).abs().max() / wanted.abs().max().clamp_min(1e-30)
    )


@contextmanager
def gpu() -> Iterator[tuple[str, str]]:
    """Where ops run on a GPU: the device of their tensors, and its name."""
    reason = gpu_unavailable_reason()
    if reason is None:
        yield "cuda", torch.cuda.get_device_name()
        return
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    pytest: Any = __import__("pytest")
    emulated: Any = __import__("emulated_gpu")
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        module = emulated.build_module(Path(folder))
        emulated.on_emulated_gpu(patch, module)
        yield "cpu", f"emulated, since {reason}"


def main() -> None:
    """Print a table in Markdown."""
    chosen = cases()
    exact = {
        name: compute(on(given, "cpu", torch.float64)) for name, (compute, given) in chosen.items()
    }
    cpu = {
        name: compute(on(given, "cpu", torch.float32)) for name, (compute, given) in chosen.items()
    }
    with gpu() as (device, called):
        there = {
            name: compute(on(given, device, torch.float32))
            for name, (compute, given) in chosen.items()
        }
        print(f"GPU: {called}\n")
    print(
        "| op | result | GPU, to the CPU's float64 | CPU's float32, to its float64 | GPU, to the CPU's float32 |"
    )
    print("|---|---|---|---|---|")
    for name, parts in exact.items():
        for part, wanted in parts.items():
            own = cpu[name][part]
            found = there[name][part]
            figures = distance(found, wanted), distance(own, wanted), distance(found, own)
            print(f"| {name} | {part} | " + " | ".join(f"{x:.1e}" for x in figures) + " |")


if __name__ == "__main__":
    main()
