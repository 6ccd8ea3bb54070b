"""Bodies to begin motion with: Gaussians where they are found, and splines of how they move and turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.deform.bodies.field import BodyField
from dyngs.deform.bodies.paths import Path, found_paths
from dyngs.deform.bodies.shots import Shots
from dyngs.deform.bodies.turning import FINE, Turning, angles_deg, cells, found_turning
from dyngs.deform.field import MAX_KEY_TIMES, DeformationField
from dyngs.deform.spline_fit import spline_basis
from dyngs.gaussians import Gaussians

AGREES = 0.85  # Disagreement of colours as a fraction of that of a body that does not turn, from which it turns
INNER, LOGIT, SCALE = 0.7, 0.0, 0.6
"""Of the Gaussians that begin on a body: least distance from its centre in radii, opacity, and size in distances."""
PX_PER_SEED = 2.0  # Area of the surface in pixels
STIFFNESS = 1e-3


@dataclass(frozen=True)
class Body:
    """A thing that moves rigidly over the times of T images."""

    path: Path
    turning: Turning


@dataclass(frozen=True)
class Bodies:
    """Bodies that were found, and the times of the images."""

    times: np.ndarray
    bodies: tuple[Body, ...]
    finding: str

    def seeds(self, shots: Shots, limit: int, num_terms: int) -> list[Gaussians]:
        """Return the Gaussians to begin with, at most ``limit``, where each body is in the middle of the clip."""
        return [_seeds(body, shots, limit // len(self.bodies), num_terms) for body in self.bodies]

    def field(self, others: DeformationField, labels: Tensor) -> BodyField:
        """Return ``others`` with the bodies' motion for the Gaussians with ``labels`` (M,), -1 for none."""
        pieces = min(max(len(self.times) // 2, 1), MAX_KEY_TIMES)
        basis = spline_basis(torch.from_numpy(self.times), pieces).numpy()
        splines = {
            "places": np.stack([_fitted(basis, body.path.centers) for body in self.bodies]),
            "quats": np.stack([_fitted(basis, _quats(body.turning.rotations)) for body in self.bodies]),
        }
        centers = np.stack([body.path.centers[len(self.times) // 2] for body in self.bodies])
        device = labels.device
        points = {name: torch.from_numpy(x).float().to(device) for name, x in splines.items()}
        return BodyField(others, torch.from_numpy(centers).float().to(device), labels, points)


def found_bodies(shots: Shots) -> Bodies | None:
    """Return what moves rigidly; None where nothing does."""
    found = [Body(path, found_turning(shots, path)) for path in found_paths(shots)]
    bodies = tuple(body for body in found if body.turning.disagreement < AGREES * body.turning.standing)
    if not bodies:
        return None
    turns = [angles_deg(np.einsum("tij,tkj->tik", b.turning.rotations[1:], b.turning.rotations[:-1])) for b in bodies]
    said = ", ".join(f"by {turn.sum():.0f} degrees" for turn in turns)
    things = "1 body moves rigidly and turns" if len(bodies) == 1 else f"{len(bodies)} bodies move rigidly and turn"
    return Bodies(shots.times, bodies, f"{things} {said}: taken")


def _seeds(body: Body, shots: Shots, limit: int, num_terms: int) -> Gaussians:
    middle, random, radius = len(shots) // 2, np.random.default_rng(0), body.path.radius
    _, depths = shots.projected(np.arange(len(shots)), body.path.centers)
    pixels = 4 * np.pi * float(np.median(radius * shots.focal / depths)) ** 2
    count = min(limit, max(int(pixels / PX_PER_SEED), 1))
    ways = random.normal(size=(count, 3))
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    away = radius * random.uniform(INNER, 1.0, size=(count, 1))
    usual = body.turning.colors[body.turning.counts > 0].mean(0)
    place = cells(ways, FINE)
    colors = np.where(body.turning.counts[place, None] > 0, body.turning.colors[place], usual)
    sh = torch.zeros(count, num_terms, 3, device="cpu")
    sh[:, 0] = torch.from_numpy((colors - 0.5) / SH_C0).float()
    spacing = radius * math.sqrt(4 * math.pi / count)
    return Gaussians(
        means=torch.from_numpy(body.path.centers[middle] + away * ways).float(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device="cpu").repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(SCALE * spacing), device="cpu"),
        logit_opacities=torch.full((count,), LOGIT, device="cpu"),
        sh=sh,
    )


def _quats(rotations: np.ndarray) -> np.ndarray:
    """Return (T, 4) quaternions wxyz of ``rotations`` (T, 3, 3), each on the side of the one before."""
    from scipy.spatial.transform import Rotation

    quats = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    signs = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    return quats * np.concatenate([[1.0], np.cumprod(signs)])[:, None]


def _fitted(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the (P, D) control points nearest to ``values`` (T, D), with small second differences."""
    bends = STIFFNESS**0.5 * np.diff(np.eye(basis.shape[1]), n=2, axis=0)
    right = np.concatenate([values, np.zeros((len(bends), values.shape[1]))])
    return np.linalg.lstsq(np.concatenate([basis, bends]), right, rcond=None)[0]


def labels_of(seeds: Sequence[Gaussians], others: int) -> Tensor:
    """Return the (M,) labels of ``others`` Gaussians of no body, followed by ``seeds``."""
    return torch.cat([torch.full((count,), i) for i, count in ((-1, others), *enumerate(map(len, seeds)))])
