"""Quadratic Bezier triangles and their colours.

P triangles; K colours of each: at its six control points while ``texture`` is 0, else at the points
of a lattice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.conventions import num_sh_terms
from dyngs.core.state import Role, State, StateTensor, with_role
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.ops.patches import NUM_POINTS, lattice, lattice_size, patch_values

CORNERS = (0, 3, 5)  # control points 200, 020, 002
_EDGES = ((0, 3), (0, 5), (3, 5))  # corners that the points 110, 101, 011 lie between
_BETWEEN = (1, 2, 4)
MOST_TEXTURE, MOST_DEGREE = 16, 4


@dataclass(frozen=True)
class Patches:
    """P triangles."""

    points: Tensor  # (P, 6, 3) control points, world
    colours: Tensor  # (P, K, 3) seen from the middle of all directions
    # (P, T - 1, 3) of the direction from the camera, added to them; without the constant
    harmonics: Tensor
    texture: int = 0  # segments of the lattice of colours; 0: those of the control points

    def __len__(self) -> int:
        return len(self.points)

    @property
    def sh_degree(self) -> int:
        return int((self.harmonics.shape[1] + 1) ** 0.5) - 1

    @property
    def num_values(self) -> int:
        """Number of values that are learned."""
        return sum(x.numel() for x in self.tensors.values())

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """All that is learned, by name; a row of each is a triangle."""
        return {"points": self.points, "colours": self.colours, "harmonics": self.harmonics}

    def of(self, tensors: Mapping[str, Tensor]) -> Patches:
        """Return triangles with other ``tensors``."""
        return replace(self, **tensors)

    def colours_at(self, ids: Tensor, uv: Tensor) -> Tensor:
        """Return (N, 3) colours without harmonics of places (N, 2) on triangles (N,) int32."""
        return patch_values(self.colours, ids, uv, self.texture)

    @property
    def areas(self) -> Tensor:
        """(P,) areas of the four flat triangles between corners and middles of the edges, world
        units squared."""
        places, faces = lattice(2)
        a, b, c = evaluated(self.points.detach(), places)[:, faces].unbind(2)
        return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=-1).sum(1)

    @property
    def elongations(self) -> Tensor:
        """(P,) the longest over the middle side of the boxes around the corners."""
        corners = self.points.detach()[:, CORNERS]
        sides = (corners.amax(1) - corners.amin(1)).sort(1).values
        return sides[:, 2] / sides[:, 1].clamp_min(1e-12)

    def textured(self, segments: int) -> Patches:
        """Return them with the colours at the points of a lattice."""
        places, _ = lattice(segments)
        return replace(self, colours=evaluated(self.colours.detach(), places), texture=segments)

    def state(self) -> State:
        texture = StateTensor(torch.tensor([self.texture], device="cpu"), Role.SHARED)
        learned = {name: x.detach() for name, x in self.tensors.items()}
        return with_role(learned, Role.SHARED) | {"texture": texture}

    @staticmethod
    def restored(stored: Mapping[str, Tensor]) -> Patches:
        """Return the triangles in a state. Raises KeyError or ValueError where its tensors do not
        fit."""
        texture = int(require_indices("texture", stored["texture"], (1,), MOST_TEXTURE + 1))
        points = require_tensor("points", stored["points"], (None, NUM_POINTS, 3))
        count = len(points)
        size = lattice_size(texture) if texture else NUM_POINTS
        colours = require_tensor("colours", stored["colours"], (count, size, 3))
        harmonics = require_tensor("harmonics", stored["harmonics"], (count, None, 3))
        if count == 0 or harmonics.shape[1] + 1 not in {
            num_sh_terms(n) for n in range(MOST_DEGREE + 1)
        }:
            raise ValueError(
                f"'points' and 'harmonics' are no triangles: {count}, {harmonics.shape[1]} terms"
            )
        return Patches(points.clone(), colours.clone(), harmonics.clone(), texture)


def evaluated(values: Tensor, places: Tensor) -> Tensor:
    """Return (P, N, C): quadratic ``values`` (P, 6, C) of every triangle at the same ``places`` (N,
    2)."""
    count = len(values)
    ids = torch.arange(count, dtype=torch.int32, device="cpu").repeat_interleave(len(places))
    uv = places.to(values.dtype).repeat(count, 1)
    return patch_values(values, ids, uv).view(count, len(places), values.shape[2])


def quarters(values: Tensor) -> Tensor:
    """Return (4 P, 6, C): quadratic ``values`` (P, 6, C) on the parts that middles of edges cut a
    triangle into."""
    places, faces = lattice(2)
    corners = places[faces]  # (4, 3, 2)
    middles = torch.stack(
        [(corners[:, i] + corners[:, j]) / 2 for i, j in ((0, 1), (0, 2), (1, 2))], 1
    )
    at = evaluated(values, torch.cat([corners, middles], 1).flatten(0, 1)).view(
        -1, 6, values.shape[2]
    )
    parts = torch.empty_like(at)
    parts[:, list(CORNERS)] = at[:, :3]
    for n, (between, (a, b)) in enumerate(zip(_BETWEEN, _EDGES, strict=True)):
        parts[:, between] = 2 * at[:, 3 + n] - 0.5 * (parts[:, a] + parts[:, b])
    return parts


def flat_triangles(corners: Tensor) -> Tensor:
    """Return (P, 6, C) control points of flat triangles with ``corners`` (P, 3, C)."""
    a, b, c = corners.unbind(1)
    return torch.stack([a, (a + b) / 2, (a + c) / 2, b, (b + c) / 2, c], 1)
