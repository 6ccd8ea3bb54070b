"""Gaussians of a body moved by its joints, forward and backward: the native op beside plain torch.

    python benchmarks/posing.py [--gaussians 10000] [--joints 24] [--repeats 30] [--threads 1]
    [--device cpu]

Plain torch blends the transforms, moves the means, and takes the covariances apart by
``torch.linalg.svd``. Medians of calls in turn, after one that does not count.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor

from dyngs.human.body.skinning import apply_transforms, blend_transforms
from dyngs.ops.native import active_isa, kernel_threads
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.quaternions import quats_from_matrices, rotation_matrices

Results = tuple[Tensor, Tensor, Tensor]


def random_body(count: int, joints: int, device: str) -> list[Tensor]:
    """Means, quaternions and log scales of N Gaussians that follow four of J joints each, weights
    and transforms."""
    generator = torch.Generator().manual_seed(0)
    followed = torch.randint(joints, (count, 4), generator=generator)
    weights = torch.zeros(count, joints).scatter_add_(
        1, followed, torch.rand(count, 4, generator=generator)
    )
    turns = torch.randn(joints, 4, generator=generator) * 0.3 + torch.tensor([1.0, 0, 0, 0])
    shifts = torch.randn(joints, 3, 1, generator=generator)
    body = [torch.randn(count, size, generator=generator) for size in (3, 4, 3)]
    body += [
        weights / weights.sum(1, keepdim=True),
        torch.cat([rotation_matrices(turns), shifts], dim=-1),
    ]
    return [x.to(device).requires_grad_() for x in body]


def native(
    means: Tensor, quats: Tensor, log_scales: Tensor, weights: Tensor, transforms: Tensor
) -> Results:
    posed = pose_by_joints(means, quats, log_scales, weights, transforms)
    return posed.means, posed.quats, posed.log_scales


def in_torch(
    means: Tensor, quats: Tensor, log_scales: Tensor, weights: Tensor, transforms: Tensor
) -> Results:
    blended = blend_transforms(weights, transforms)
    half = blended[..., :3] @ (rotation_matrices(quats) * log_scales.exp()[:, None])
    axes, lengths, _ = torch.linalg.svd(half)
    proper = axes * torch.linalg.det(axes)[:, None, None]
    return apply_transforms(blended, means), quats_from_matrices(proper), lengths.log()


def timed(call: Callable[[], object], device: str) -> float:
    """Milliseconds."""
    if device == "cuda":
        torch.cuda.synchronize()
    begin = time.perf_counter()
    call()
    if device == "cuda":
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in (("gaussians", 10_000), ("joints", 24), ("repeats", 30), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    options = parser.parse_args()
    body = random_body(options.gaussians, options.joints, options.device)
    ways = {"native": native, "plain torch": in_torch}
    forward: dict[str, list[float]] = {name: [] for name in ways}
    both: dict[str, list[float]] = {name: [] for name in ways}
    with kernel_threads(options.threads):
        grads = [torch.randn_like(x) for x in native(*body)]
        for number in range(options.repeats + 1):
            for name, pose in ways.items():
                times = (
                    timed(lambda pose=pose: pose(*body), options.device),
                    timed(
                        lambda pose=pose: torch.autograd.grad(pose(*body), body, grads),
                        options.device,
                    ),
                )
                if number:
                    forward[name].append(times[0])
                    both[name].append(times[1])
    print(
        f"{options.gaussians:,} Gaussians, {options.joints} joints, {options.threads} thread(s), {active_isa()}"
    )
    for name in ways:
        print(
            f"{name:<12} forward {median(forward[name]):7.2f} ms, with backward {median(both[name]):7.2f} ms"
        )


if __name__ == "__main__":
    main()
