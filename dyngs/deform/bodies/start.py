"""Bodies to begin motion with: Gaussians where they are found, and splines of how they move and
turn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from dyngs.core.conventions import SH_C0
from dyngs.deform.bodies.field import BodyField, BodyRest
from dyngs.deform.bodies.paths import Path, clear_, found_paths
from dyngs.deform.bodies.shots import Shots
from dyngs.deform.bodies.turning import FINE, Turning, cells, found_turning
from dyngs.deform.field import MAX_KEY_TIMES, DeformationField
from dyngs.deform.spline_fit import spline_basis
from dyngs.gaussians import Gaussians
from dyngs.ops.quaternions import shorter_ways

AGREES, BY_CHANCE = 0.6, 0.4
"""Disagreement of a body's colours, as a fraction of that if it did not turn, and of that of any of
its colours.

Balls that roll have 0.16 to 0.47 of the former. A die, for which the ball is a poor model, has
0.75, be its rotation 5 degrees off or 26, where following it cost 1.5 dB."""
# Disagreement of any of its colours below which these say nothing about how it turns
LEAST_MARKS = 0.04
SMALLEST = 32  # Sides of images, in pixels, that may tell how something turns
# That are sought, and paths that may prove to be none before the search ends
MOST_BODIES, MOST_REFUSED = 6, 4
INNER, LOGIT, SCALE = 0.7, 0.0, 0.6
"""Of the Gaussians that begin on a body: least distance from its centre in radii, opacity, and size
in distances."""
MARKED, LEFT = 0.35, 0.3
"""Mean difference of 5x5 pixels that shows motion for sure, and the part of all such that bodies
need not explain."""
PIECES_PER_TIME = 0.35
PX_PER_SEED = 2.0  # Area of the surface in pixels
STIFFNESS = 0.1


@dataclass(frozen=True)
class Body:
    """A thing that moves rigidly over the times of T images."""

    path: Path
    turning: Turning


@dataclass(frozen=True)
class Bodies:
    """Bodies that were found, and how they were seen."""

    shots: Shots
    bodies: tuple[Body, ...]
    seeds: tuple[Gaussians, ...]  # of each, where it is in the middle of the clip

    @property
    def finding(self) -> str:
        """A line about them."""
        from scipy.spatial.transform import Rotation

        turns = [Rotation.from_matrix(body.turning.rotations) for body in self.bodies]
        turns = [np.degrees((turn[1:] * turn[:-1].inv()).magnitude()).sum() for turn in turns]
        things = "1 body turns" if len(turns) == 1 else f"{len(turns)} bodies turn"
        clip = "followed at all times at once" if self.explain_all else "other things move, too"
        return f"{things} by {', '.join(f'{turn:.0f}' for turn in turns)} degrees; {clip}"

    @cached_property
    def explain_all(self) -> bool:
        """Whether hardly anything else moves."""
        from scipy.ndimage import uniform_filter

        maps = self.shots.differences()
        marked = maps * (uniform_filter(maps, 5, axes=(1, 2)) > MARKED)
        whole = float(marked.sum())
        for body in self.bodies:
            clear_(marked, self.shots, body.path)
        return float(marked.sum()) < LEFT * whole

    def within(self, others: DeformationField) -> BodyField:
        """Return the field of ``others`` in which the last of the moving Gaussians, the seeds, are
        the bodies'."""
        num_pieces = min(max(round(PIECES_PER_TIME * len(self.shots)), 1), MAX_KEY_TIMES)
        basis = spline_basis(torch.from_numpy(self.shots.times), num_pieces).numpy()
        splines = {
            "places": [_fitted(basis, body.path.centers) for body in self.bodies],
            "quats": [_fitted(basis, _quats(body.turning.rotations)) for body in self.bodies],
        }
        centers = np.stack([body.path.centers[len(self.shots) // 2] for body in self.bodies])
        counts = [len(seeds) for seeds in self.seeds]
        labels = torch.repeat_interleave(
            torch.tensor([others.setup.num_moving - sum(counts), *counts], device="cpu")
        )
        device = others.setup.center.device
        points = {
            name: torch.from_numpy(np.stack(x)).float().to(device) for name, x in splines.items()
        }
        radii = torch.tensor([body.path.radius for body in self.bodies], device=device)
        rest = BodyRest(
            torch.from_numpy(centers).float().to(device), radii, (labels - 1).to(device)
        )
        albedo = torch.cat([seeds.sh[:, 0] + 0.5 / SH_C0 for seeds in self.seeds]).to(device)
        albedo = torch.cat([albedo.new_zeros(len(labels) - len(albedo), 3), albedo])
        # of the cameras
        up = torch.from_numpy(-self.shots.poses[:, 1, :3].mean(0)).float().to(device)
        return BodyField(others, rest, points | {"albedo": albedo, "sun": up})


def found_bodies(shots: Shots, limit: int, num_terms: int) -> Bodies | None:
    """Return what moves rigidly, with at most ``limit`` Gaussians of ``num_terms`` harmonics; None
    where nothing does.

    A body is taken if the colours of its surface, each compared with other images, agree clearly
    better than if it did not turn, and than by chance: what bends shows other colours in the same
    direction.
    """
    bodies = _rigid_bodies(shots) if limit and min(shots.size) >= SMALLEST else ()
    if not bodies or limit < len(bodies):
        return None
    return Bodies(
        shots,
        bodies,
        tuple(_seeds(body, shots, limit // len(bodies), num_terms) for body in bodies),
    )


def _rigid_bodies(shots: Shots) -> tuple[Body, ...]:
    """Return what moves rigidly; each is taken out before the next is sought, and what hides others
    where none is."""
    maps = shots.differences()
    bodies = []
    refused = []
    while len(bodies) < MOST_BODIES and len(refused) < MOST_REFUSED:
        paths = found_paths(shots, maps)
        if not paths:
            break
        fresh = [path for path in paths if not any(path.is_like(other) for other in refused)]
        for path in fresh[: MOST_REFUSED - len(refused)]:
            body = Body(path, found_turning(shots, path))
            if _is_rigid(body.turning):
                bodies.append(body)
                clear_(maps, shots, path)
                break
            refused.append(path)
        else:
            clear_(maps, shots, paths[0])
    return tuple(bodies)


def _is_rigid(turning: Turning) -> bool:
    least = min(AGREES * turning.standing, BY_CHANCE * turning.by_chance)
    return turning.by_chance >= LEAST_MARKS and turning.disagreement < least


def _seeds(body: Body, shots: Shots, limit: int, num_terms: int) -> Gaussians:
    middle = len(shots) // 2
    random = np.random.default_rng(0)
    radius = body.path.radius
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
    """Return (T, 4) quaternions wxyz of ``rotations`` (T, 3, 3), each on the side of the one
    before."""
    from scipy.spatial.transform import Rotation

    return shorter_ways(Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]])


def _fitted(basis: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the (P, D) control points nearest to ``values`` (T, D), with small second
    differences."""
    bends = STIFFNESS**0.5 * np.diff(np.eye(basis.shape[1]), n=2, axis=0)
    right = np.concatenate([values, np.zeros((len(bends), values.shape[1]))])
    return np.linalg.lstsq(np.concatenate([basis, bends]), right, rcond=None)[0]
