"""Checks of the tensors of a stored avatar: shapes, ranges and indices, so that it can be posed and drawn.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, F frames, M vertices and T triangles of the
template.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.human.avatar.light import TERMS
from dyngs.human.pose.skinning import check_tree
from dyngs.human.template.joints import SMPLX_ROWS
from dyngs.tensor_checks import require_indices, require_moments, require_positive, require_tensor

_MOST_FACES = 2**31


def require_avatar(gaussians: Gaussians, state: Mapping[str, Tensor]) -> None:
    """Check the state of an avatar against its Gaussians.

    Raises:
        KeyError: a tensor is missing.
        ValueError: a tensor has a wrong shape, type or range.
    """
    n, j, f = len(gaussians), len(state["joints"]), len(state["clip.times"])
    require_body(n, gaussians.sh.shape[1], state["parents"], j)
    require_moments("clip.times", state["clip.times"])
    shapes = dict.fromkeys(("joints", "learned.joints", "learned.turns"), (j, 3))
    shapes |= dict.fromkeys(("clip.poses", "learned.poses"), (f, j, 3))
    shapes |= dict.fromkeys(("clip.trans", "learned.trans"), (f, 3))
    shapes |= {"clip.scale": (f,), "learned.log_scale": (1,)}
    for name, shape in shapes.items():
        require_tensor(name, state[name], shape)
    require_positive("clip.scale", state["clip.scale"])
    if not f:
        raise ValueError("the clip has no frame")
    prefix = "anchors."
    require_anchors({name.removeprefix(prefix): x for name, x in state.items() if name.startswith(prefix)}, n, j)
    if bool((state["anchors.weights"] < 0).any()) or not bool((state["anchors.weights"].sum(1) > 0).all()):
        raise ValueError("the skinning weights of a Gaussian are negative or sum to 0")
    require_tensor("learned.weights", state["learned.weights"], tuple(state["anchors.weights"].shape))
    if "learned.pose_dirs" in state:
        require_tensor("learned.pose_dirs", state["learned.pose_dirs"], (n, 27))
    if "learned.light" in state:
        require_tensor("learned.light", state["learned.light"], (TERMS, 3))
        require_tensor("learned.normals", state["learned.normals"], (n, 3))
    if "shapes.directions" in state:
        require_indices("anchors.face", state["anchors.face"], (n,), len(state["shapes.faces"]))
    if "near" in state:
        require_indices("near", state["near"], (n, None), n)


def require_body(num_gaussians: int, terms: int, parents: Tensor, num_joints: int) -> None:
    """Check that the Gaussians have 1 or 4 harmonics and the skeleton is of a known family. Raises ValueError."""
    if num_joints not in SMPLX_ROWS or terms not in (1, 4):
        raise ValueError(f"{num_gaussians} Gaussians of {terms} harmonics on {num_joints} joints")
    if parents.is_floating_point() or tuple(parents.shape) != (num_joints,):
        raise ValueError(f"'parents' is {parents.dtype} {tuple(parents.shape)}, not whole numbers ({num_joints},)")
    check_tree(tuple(parents.tolist()))


def require_anchors(anchors: Mapping[str, Tensor], num_gaussians: int, num_joints: int) -> None:
    """Check the anchors of N Gaussians on J joints. Raises KeyError or ValueError."""
    n, k = num_gaussians, anchors["weights"].shape[-1]
    shapes = {"points": (n, 3), "size": (n,), "barycentric": (n, 3), "uv": (n, 2), "height": (n,), "weights": (n, k)}
    for name, shape in shapes.items():
        require_tensor(f"anchors.{name}", anchors[name], shape)
    require_indices("anchors.joints", anchors["joints"], (n, k), num_joints)
    require_indices("anchors.face", anchors["face"], (n,), _MOST_FACES)


def require_shapes(directions: Tensor, faces: Tensor, num_joints: int) -> None:
    """Check the pose blend shapes of a template with J joints. Raises ValueError."""
    require_tensor("shapes.directions", directions, (9 * (num_joints - 1), None), torch.float16)
    require_indices("shapes.faces", faces, (None, 3), directions.shape[1] // 3, torch.int32)
    if directions.shape[1] % 3:
        raise ValueError(f"'shapes.directions' has {directions.shape[1]} columns, not three for each vertex")
