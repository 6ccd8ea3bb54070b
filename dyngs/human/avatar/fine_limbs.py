"""Hands and feet on smaller texels, where the images have pixels for them.

The atlas of a template gives a face much room and a finger one texel across. Local letter: N Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors, texel_gaussians
from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.atlas import Texels, atlas_texels
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.joints import JOINT_NAMES

FINER = 2
"""Texels of the finer atlas along a side of one."""
PIXELS = 2.0
"""Pixels along the side of a texel from which it is replaced by smaller ones."""
_LIMBS = ("wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")


def pixel_size(cameras: Sequence[Cameras], clip: MotionClip, pelvis: Tensor) -> float:
    """Return the side of a pixel on the person, m of the template: the median over the cameras; infinite without any.

    Args:
        cameras: of the training views, as large as the images.
        clip: where the person is; the mean place counts.
        pelvis: (3,) at rest, m.
    """
    scale = float(clip.scale.mean())
    place = clip.trans.mean(0) + scale * pelvis
    away = [float((camera.centers[0] - place).norm() / camera.intrinsics[0, 0, 0]) for camera in cameras]
    return sorted(away)[len(away) // 2] / scale if away else torch.inf


def surface_texels(body: BodyTemplate, resolution: int, vertices: Tensor, pixel: float) -> list[Texels]:
    """Return the texels of the atlas, and apart from them smaller ones of hands and feet where images show more.

    Args:
        body: a template with texture coordinates.
        resolution: texels along a side of the atlas.
        vertices: (M, 3) rest shape, m.
        pixel: side of a pixel on the person, m.
    """
    texels = atlas_texels(body, resolution, vertices)
    named = [any(part in name for part in _LIMBS) for name in JOINT_NAMES[: len(body.parents)]]
    limbs = torch.tensor(named, device=texels.points.device)
    on_limbs = limbs[texels.weights.argmax(1)]
    if not bool(on_limbs.any()) or float(texels.size[on_limbs].median()) < PIXELS * pixel:
        return [texels]
    fine = atlas_texels(body, FINER * resolution, vertices)
    return [texels.select(~on_limbs), fine.select(limbs[fine.weights.argmax(1)])]


def surface_gaussians(
    parts: Sequence[Texels], heights: Sequence[float], sh_degree: int
) -> tuple[Gaussians, Anchors, Tensor]:
    """Return the ``texel_gaussians`` of all parts, part by part, their anchors, and their normals (N, 3)."""
    made = [texel_gaussians(texels, heights, sh_degree) for texels in parts]
    normals = torch.cat([texels.normals.repeat(len(heights), 1) for texels in parts])
    gaussians = {name: torch.cat([g.tensors()[name] for g, _ in made]) for name in made[0][0].tensors()}
    anchors = {name: torch.cat([a.tensors()[name] for _, a in made]) for name in made[0][1].tensors()}
    return Gaussians(**gaussians), Anchors(**anchors), normals
