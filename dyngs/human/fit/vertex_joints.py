"""Joints of posed vertices: a body's joints go with the vertices that follow them.

Local letters: F frames, N vertices, J joints.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyngs.errors import DyngsError
from dyngs.human.template.body import BodyTemplate

NUM_JOINTS = 22
"""Joints of the body without hands and face, the same in SMPL, SMPL-H and SMPL-X."""
NEAR = 0.5
"""A vertex tells where a joint is if it follows that joint and its parent by this share at least."""


def joints_of_vertices(where: Path, body: BodyTemplate, vertices: np.ndarray) -> np.ndarray:
    """Return the joints (F, 22, 3) of posed vertices (F, N, 3) of a body with N vertices; NaN where they do not tell.

    The vertices around a joint, which follow it or its parent, are moved from rest to the pose by the similarity that
    fits them best (Umeyama 1991); so is the joint.

    Raises:
        DyngsError: another number of vertices; names ``where``.
    """
    rest, joints = body.vertices.double().cpu().numpy(), body.joints.double().cpu().numpy()
    if vertices.ndim != 3 or vertices.shape[1:] != rest.shape:
        raise DyngsError(
            f"{where}: 'vertices' has the shape {'x'.join(map(str, vertices.shape))}, the body {len(rest)} of them; "
            "give the body file that they belong to (--body)"
        )
    weights = body.weights.double().cpu().numpy()
    found = np.full((len(vertices), NUM_JOINTS, 3), np.nan)
    for joint, parent in enumerate(body.parents[:NUM_JOINTS]):
        own = weights[:, joint] + (weights[:, parent] if parent >= 0 else 0.0)
        near = np.minimum(weights[:, joint], weights[:, parent]) if parent >= 0 else weights[:, joint]
        rows = np.flatnonzero((own > NEAR) & (near > 0.05))
        if len(rows) >= 4:
            found[:, joint] = [_moved(rest[rows], posed[rows], joints[joint]) for posed in vertices]
    return found


def _moved(rest: np.ndarray, posed: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the point (3,) moved by the similarity that takes points (P, 3) from rest to where they are posed."""
    if not np.isfinite(posed).all():
        return np.full(3, np.nan)
    middle, place = rest.mean(0), posed.mean(0)
    u, s, v = np.linalg.svd((posed - place).T @ (rest - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v)) or 1.0])
    scale = (s * signs).sum() / max(float(((rest - middle) ** 2).sum()), 1e-12)
    return place + scale * (u * signs) @ v @ (point - middle)
