"""A body template: rest mesh, shape space, joints and skinning weights, and its vertices in any pose.

Local letters: J joints, M vertices, T triangles, U UV vertices, F frames, B shape and E expression parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.human.pose.skinning import (
    apply_transforms,
    axis_angle_to_matrix,
    blend_transforms,
    check_tree,
    joint_transforms,
)


@dataclass(frozen=True)
class BodyTemplate:
    """A body template: rest mesh, shape space, joints and skinning weights; float32 tensors, metres, y up, facing +z,
    +x the person's left.

    Attributes:
        name: "anny", "smpl", "smplh" or "smplx": whose joints these are.
        vertices: (M, 3) at rest.
        faces: (T, 3) long, counter-clockwise from outside.
        uv: (U, 2) in [0, 1], image row = (1 - v) * H; or None.
        uv_faces: (T, 3) long into ``uv``, same order and corners as ``faces``; None together with ``uv``.
        weights: (M, J), rows sum to 1.
        parents: (J,) parent of each joint, -1 for the root; smaller than the joint's own number.
        joints: (J, 3) at rest, of the mean shape.
        shape_dirs: (M, 3, B) metres per unit of the shape parameters, or None.
        expression_dirs: (M, 3, E) likewise, or None.
        joint_shape_dirs: (J, 3, B) what they do to the joints; None together with ``shape_dirs``.
        joint_expression_dirs: (J, 3, E) likewise; None together with ``expression_dirs``.
        pose_dirs: (9 (J - 1), 3 M) metres per unit of the rotations' difference from the identity, or None.
    """

    name: str
    vertices: Tensor
    faces: Tensor
    uv: Tensor | None
    uv_faces: Tensor | None
    weights: Tensor
    parents: tuple[int, ...]
    joints: Tensor
    shape_dirs: Tensor | None = None
    expression_dirs: Tensor | None = None
    joint_shape_dirs: Tensor | None = None
    joint_expression_dirs: Tensor | None = None
    pose_dirs: Tensor | None = None

    def __post_init__(self) -> None:
        """Raises ValueError where shapes do not fit each other or a parent does not come before its joint."""
        check_tree(self.parents)
        m, j = len(self.vertices), len(self.parents)
        b, e = self.num_shapes, self.num_expressions
        wanted = {"vertices": (m, 3), "faces": (len(self.faces), 3), "uv_faces": (len(self.faces), 3)}
        wanted |= {"weights": (m, j), "joints": (j, 3), "pose_dirs": (9 * (j - 1), 3 * m)}
        wanted |= {"shape_dirs": (m, 3, b), "joint_shape_dirs": (j, 3, b)}
        wanted |= {"expression_dirs": (m, 3, e), "joint_expression_dirs": (j, 3, e)}
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value is not None and tuple(value.shape) != shape:
                raise ValueError(f"{name} must be {shape}, got {tuple(value.shape)}")
        pairs = (("uv", "uv_faces"), ("shape_dirs", "joint_shape_dirs"), ("expression_dirs", "joint_expression_dirs"))
        for first, second in pairs:
            if (getattr(self, first) is None) != (getattr(self, second) is None):
                raise ValueError(f"{first} and {second} must be given together")

    @property
    def num_shapes(self) -> int:
        """B, 0 without a shape space."""
        return 0 if self.shape_dirs is None else self.shape_dirs.shape[-1]

    @property
    def num_expressions(self) -> int:
        """E, 0 without expressions."""
        return 0 if self.expression_dirs is None else self.expression_dirs.shape[-1]

    def to(self, dtype: torch.dtype) -> BodyTemplate:
        """The same body with its floating-point numbers in ``dtype``."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        floats = {k: x.to(dtype) for k, x in values.items() if isinstance(x, Tensor) and x.is_floating_point()}
        return replace(self, **floats)


def apply_shape(body: BodyTemplate, betas: Tensor | None, expression: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Vertices (..., M, 3) and joints (..., J, 3) at rest of a person of this shape; differentiable.

    v = v_mean + S beta + E psi, and the joints alike, as they are linear in the vertices.

    Args:
        body: the template.
        betas: (..., B) shape parameters; fewer leave the others at 0. None is the mean shape.
        expression: (..., E) likewise.

    Raises:
        DyngsError: a parameter that is not 0 and that the body does not have.
    """
    vertices, joints = body.vertices, body.joints
    for name, given, dirs, joint_dirs in (
        ("betas", betas, body.shape_dirs, body.joint_shape_dirs),
        ("expression", expression, body.expression_dirs, body.joint_expression_dirs),
    ):
        if given is None:
            continue
        known = 0 if dirs is None else dirs.shape[-1]
        if given[..., known:].any():
            raise DyngsError(
                f"{name}: {given.shape[-1]} numbers given, but the {body.name} body has {known or 'none'}; "
                "leave out the others or set them to 0"
            )
        if dirs is not None and joint_dirs is not None:
            used = given[..., :known]
            vertices = vertices + _combined(dirs, used)
            joints = joints + _combined(joint_dirs, used)
    return vertices, joints


def posed_vertices(
    body: BodyTemplate,
    poses: Tensor,
    trans: Tensor,
    betas: Tensor | None = None,
    expression: Tensor | None = None,
    scale: Tensor | None = None,
) -> Tensor:
    """(F, M, 3) vertices of F frames, m; differentiable in all that is given (SMPL: Loper et al. 2015).

    v = scale * (sum_j w_j A_j) (v_shaped + P vec(R_1 - 1, ..)) + trans. The root turns about the pelvis joint.

    Args:
        body: the template, of the same floating-point type as all the rest.
        poses: (F, J, 3) axis-angle relative to the parent joint, rad.
        trans: (F, 3) m, added last.
        betas: (B,) or (F, B) shape parameters, see ``shaped``.
        expression: (E,) or (F, E) likewise.
        scale: (F,) uniform scale of the template; None is 1.

    Raises:
        DyngsError: poses of another number of joints, or parameters that the body does not have.
    """
    if poses.ndim != 3 or tuple(poses.shape[1:]) != tuple(body.joints.shape):
        raise DyngsError(
            f"poses must be (frames, {len(body.joints)}, 3) for the {body.name} body, got {tuple(poses.shape)}"
        )
    vertices, joints = apply_shape(body, betas, expression)
    turned = axis_angle_to_matrix(poses)
    if body.pose_dirs is not None:
        features = (turned[:, 1:] - torch.eye(3, dtype=poses.dtype, device=poses.device)).flatten(1)
        vertices = vertices + (features @ body.pose_dirs).unflatten(-1, (-1, 3))
    posed = apply_transforms(blend_transforms(body.weights, joint_transforms(joints, body.parents, turned)), vertices)
    if scale is not None:
        posed = scale[:, None, None] * posed
    return posed + trans[:, None]


def _combined(directions: Tensor, parameters: Tensor) -> Tensor:
    """(..., X, 3) the sum of ``directions`` (X, 3, B), of which the first n are used, in amounts (..., n)."""
    used = directions[..., : parameters.shape[-1]].flatten(0, 1)
    return (parameters @ used.T).unflatten(-1, (-1, 3))
