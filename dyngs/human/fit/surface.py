"""The template's surface as discs, in any shape and pose: its silhouettes are drawn by the rasterizer.

Local letters: P discs, B shape parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.conventions import RasterizeMode
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.human.avatar.anchors import skinning_weights, texel_gaussians
from dyngs.human.avatar.posing import BodyPose, Skeleton, pose_gaussians
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.body import BodyTemplate

_WIDTH, _THICKNESS, _INSET = 0.4, 0.075, 0.2
"""Standard deviations of a disc in the tangent plane and along the normal, and its depth below the skin, in sides of
its texel. With these, drawn silhouettes have the area of the mesh to 2 % and an IoU with it of 0.95 (48 texels a side)
to 0.97 (72); wider discs cover more than the body, narrower ones leave gaps."""
_OPACITY_LOGIT = 4.0
_OPTIONS = RenderOptions(nonfinite="trust", eps2d=0.1, mode=RasterizeMode.ANTIALIASED)


@dataclass(frozen=True)
class Surface:
    """Discs on the texels of a template, and how they follow its shape."""

    discs: Gaussians  # P at rest in the mean shape, m
    normals: Tensor  # (P, 3) outward
    weights: Tensor  # (P, J) skinning weights
    shape_dirs: Tensor  # (P, 3, B) m per unit of the shape parameters
    body: BodyTemplate  # the template

    def __len__(self) -> int:
        return len(self.weights)

    def skeleton(self, betas: Tensor) -> Skeleton:
        """Return the skeleton of shape parameters (B,); differentiable."""
        dirs = self.body.joint_shape_dirs
        joints = self.body.joints if dirs is None else self.body.joints + dirs @ betas
        return Skeleton(joints, self.body.parents)

    def in_pose(self, betas: Tensor, padding: Tensor, pose: BodyPose) -> Gaussians:
        """Return the discs in a pose, in the world; differentiable.

        ``betas`` (B,) are shape parameters; ``padding`` (P,) m, by how much clothes and hair lie outside the skin.
        """
        means = self.discs.means + self.shape_dirs @ betas + padding[:, None] * self.normals
        return pose_gaussians(self.discs.replace(means=means), self.weights, self.skeleton(betas), pose)


def surface_of(body: BodyTemplate, resolution: int) -> Surface:
    """Return the surface of a template as the discs of an atlas of ``resolution`` texels a side."""
    texels = atlas_texels(body, resolution, body.vertices)
    discs, anchors = texel_gaussians(texels, [0.0], 0)
    ratios = anchors.size.new_tensor([_WIDTH, _WIDTH, _THICKNESS]).log()
    solid = torch.full_like(discs.logit_opacities, _OPACITY_LOGIT)
    if body.shape_dirs is None:
        shape_dirs = discs.means.new_zeros(len(discs), 3, 0)
    else:
        corners = body.shape_dirs[body.faces[texels.faces]]
        shape_dirs = (texels.barycentric[..., None, None] * corners).sum(1)
    return Surface(
        discs=discs.replace(
            means=discs.means - _INSET * anchors.size[:, None] * texels.normals,
            log_scales=anchors.size.log()[:, None] + ratios,
            logit_opacities=solid,
        ),
        normals=texels.normals,
        weights=skinning_weights(anchors, len(body.joints)),
        shape_dirs=shape_dirs,
        body=body,
    )


def drawn_silhouettes(discs: Gaussians, cameras: Cameras) -> Tensor:
    """Return coverage (V, H, W) in [0, 1] of posed discs in the images of V cameras; differentiable."""
    return render(discs, cameras, _OPTIONS).alpha
