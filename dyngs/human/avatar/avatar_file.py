"""Avatar files: a trained person in one file, to be rendered in any pose without the run.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, M vertices and T triangles
of the template.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, format_one_line
from dyngs.core.section import ModelSection
from dyngs.core.state import select_prefix
from dyngs.core.tensor_checks import require_tensor
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import render_options
from dyngs.human.avatar.scene import HumanScene, as_human_scene
from dyngs.human.body.body_reader import template_path
from dyngs.human.keys import HumanModel
from dyngs.io.tensor_file import FileKind, read_tensors, write_tensors
from dyngs.models.checkpoint import CheckpointInfo, parse_info
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour

SUFFIX = ".safetensors"

_KIND = FileKind("dyngs avatar", "an avatar", 1)
_ADVICE = "; export it again with `dyngs export RUN --format avatar`"
_LONGEST_NAME = 200
"""Characters of the name of a file, which must have its place in every file system."""


def write_avatar(person: Renderable, model: ModelSection, info: CheckpointInfo, path: Path) -> Path:
    """Write an avatar in the rest pose and return ``path``; see docs/reference/bodies.md.

    Raises DyngsError: the scene is not that of a person, its template is missing, or the file cannot
    be written.
    """
    # late: scipy, which reading an avatar does without
    from dyngs.human.motion.placement import rest_clip

    scene = as_human_scene(person)
    if scene is None or not isinstance(model, HumanModel):
        raise DyngsError(
            f"--format avatar needs the run of a person (model.kind=human), this one is {model.kind}"
        )
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(f"{path}: an avatar is written as {SUFFIX}")
    if scene.colour is not None:
        raise DyngsError(
            "an avatar file holds harmonics, this run's colours are a network; train with colour.kind=sh"
        )
    reference = rest_clip(scene.clip, scene.skeleton.joints, scene.skeleton.parents)
    anchors = scene.anchors
    tensors = {f"gaussians.{name}": x for name, x in scene.gaussians.tensors().items()}
    tensors |= {f"anchors.{name}": x for name, x in anchors.tensors().items()}
    tensors |= {
        "anchors.face": anchors.face.int(),
        "anchors.joints": anchors.joints.to(torch.uint8),
        "anchors.weights": scene.weights.gather(1, anchors.joints),
        "skeleton.joints": scene.learned_skeleton.joints,
        "skeleton.template_joints": scene.skeleton.joints,
        "skeleton.parents": torch.tensor(scene.skeleton.parents, device="cpu"),
        "fit.turns": scene.fit.turns,
        "fit.log_scale": torch.tensor([scene.fit.log_scale], device="cpu"),
        "reference.poses": reference.poses[0],
        "reference.trans": reference.trans[0],
        "reference.scale": reference.scale,
    }
    if scene.shapes is not None:
        tensors |= {
            "shapes.directions": scene.shapes.directions.half(),
            "shapes.faces": scene.shapes.faces.int(),
        }
    if scene.light is not None:
        tensors |= {"light": scene.light.factors, "normals": scene.light.normals}
    file = template_path(model)
    # file and SHA-256 of the body template, which motions of other skeletons are retargeted with, and
    # whether it is the free one that comes with dyngs
    template = {"file": file.name, "sha256": _sha256(file), "packaged": model.body is None}
    header = {**asdict(info), "near": model.near, "eps2d": model.eps2d, "template": template}
    write_tensors(
        path, _KIND, {name: x.detach().contiguous() for name, x in tensors.items()}, header
    )
    return path


def read_avatar(path: Path) -> tuple[HumanModel, HumanScene, CheckpointInfo]:
    """Read the person of a file, upright and at rest, with its section and its metadata.

    A template other than the free one is looked for next to the file when a motion needs it.

    Raises:
        DyngsError: the file is missing, damaged, altered or not an avatar, or the template next to
            it is another one.
    """
    header, tensors = read_tensors(path, _KIND, _ADVICE)
    try:
        scene = _scene(tensors)
        info = parse_info(header)
        model = HumanModel(
            body=_template_beside(path, **header["template"]),
            near=header["near"],
            eps2d=header["eps2d"],
            rasterize_mode=RasterizeMode(info.rasterize_mode),
            sh_degree={1: 0, 4: 1}[scene.gaussians.sh.shape[1]],
        )
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        why = (
            f"{error.args[0]} is missing"
            if isinstance(error, KeyError)
            else format_one_line(str(error), 120)
        )
        raise DyngsError(f"{path}: not a valid avatar ({why}){_ADVICE}") from None
    options = render_options(model, info.extent, info.world_scale)
    scene = replace(scene, options=options, background=background_colour(info.background))
    return model, scene, info


def _template_beside(path: Path, file: str, sha256: str, packaged: bool) -> Path | None:
    """Return where the template of an avatar in ``path`` is or should be; None: the free one."""
    name = Path(file).name
    if len(name) > _LONGEST_NAME:
        raise ValueError("the name of its template is too long")
    template = template_path(HumanModel()) if packaged else path.parent / name
    if template.is_file() and _sha256(template) != sha256:
        whose = "that of this version of dyngs" if packaged else f"{template}"
        raise DyngsError(
            f"{path}: needs its own template '{file}', not {whose}; put that file beside it"
        )
    return None if packaged else template


def _sha256(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise DyngsError(
            f"{file}: the template cannot be read ({error.strerror}); restore it"
        ) from None


def _scene(tensors: Mapping[str, Tensor]) -> HumanScene:
    """Raises KeyError for a missing tensor, ValueError for a wrong type, shape or range."""
    joints = tensors["skeleton.template_joints"]
    poses = tensors["reference.poses"][None]
    trans = tensors["reference.trans"][None]
    stored = {
        **{f"anchors.{name}": x for name, x in select_prefix(tensors, "anchors").items()},
        **{f"shapes.{name}": x for name, x in select_prefix(tensors, "shapes").items()},
        "joints": joints,
        "parents": tensors["skeleton.parents"],
        "clip.times": torch.zeros(1, dtype=torch.float64, device="cpu"),
        "clip.poses": poses,
        "clip.trans": trans,
        "clip.scale": tensors["reference.scale"],
        "learned.poses": torch.zeros_like(poses),
        "learned.trans": torch.zeros_like(trans),
        "learned.turns": tensors["fit.turns"],
        "learned.joints": tensors["skeleton.joints"] - joints,
        "learned.log_scale": tensors["fit.log_scale"],
    }
    stored |= {f"learned.{name}": tensors[name] for name in ("light", "normals") if name in tensors}
    for name, dtype in (("anchors.face", torch.int32), ("anchors.joints", torch.uint8)):
        stored[name] = require_tensor(name, stored[name], stored[name].shape, dtype).long()
    return HumanScene.from_state(Gaussians.stored(select_prefix(tensors, "gaussians")), stored)
