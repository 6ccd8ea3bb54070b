"""Colours of texels that no image shows, guessed from those that are seen: the nearest ones, and the other side.

Local letters: P texels.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.human.template.atlas import Texels

_NEAREST = 16
"""Seen texels that an unseen one takes its colour from."""
_TURN = 0.1
"""Metres that count as much as a turn of the normal by 60 degrees."""
_SOFT = 0.01
"""Distance added, m, so that the very nearest texel does not decide alone."""
_UNKNOWN = 0.5


def mirror_texels(texels: Texels) -> Tensor:
    """Return the index (P,) of the texel nearest to the mirror image of each one, at rest."""
    places = _places(texels)
    found = KDTree(places).query(places * np.array([-1.0, 1, 1, -1, 1, 1]))[1]
    return torch.from_numpy(np.asarray(found, dtype=np.int64)).to(texels.index.device)


def colours_nearby(texels: Texels, rgb: Tensor, seen: Tensor) -> Tensor:
    """Return ``rgb`` (P, 3) where ``seen`` (P,) is positive, elsewhere the mean of seen texels that are near at rest.

    Weights fall with the squared distance, and grow with the cosine at which a texel is seen; normals count, too, so
    that the sole is not coloured like the instep. 0.5 if nothing is seen.
    """
    is_seen = (seen > 0).cpu().numpy()
    if not is_seen.any():
        return torch.full_like(rgb, _UNKNOWN)
    if is_seen.all():
        return rgb
    places, known = _places(texels), np.flatnonzero(is_seen)
    count = min(_NEAREST, len(known))
    found = KDTree(places[known]).query(places[~is_seen], k=count)
    distance, near = (np.asarray(x).reshape(-1, count) for x in found)  # one neighbour comes without its axis
    rows = torch.from_numpy(known[near.astype(np.int64)]).to(rgb.device)
    weight = seen[rows] / (torch.from_numpy(distance).to(rgb) + _SOFT).square()
    filled = rgb.clone()
    filled[torch.from_numpy(~is_seen).to(rgb.device)] = (weight[..., None] * rgb[rows]).sum(1) / weight.sum(1)[:, None]
    return filled


def _places(texels: Texels) -> np.ndarray:
    """Return the positions and scaled normals (P, 6) of the texels at rest, m."""
    return torch.cat([texels.points, _TURN * texels.normals], dim=1).double().cpu().numpy()
