"""Avatar files: a trained person in one file that can be rendered in any pose without the run.

Symbols: N Gaussians, J joints, K joints per Gaussian, M vertices and T triangles of the template.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, format_one_line, wrap_read_errors
from dyngs.core.section import ModelSection
from dyngs.core.state import select_prefix, strip_roles
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
"""Limit on the length of the template's file name; most file systems allow 255 bytes."""


def write_avatar(person: Renderable, model: ModelSection, info: CheckpointInfo, path: Path) -> Path:
    """Write an avatar in its rest pose, upright at its position in the capture; return ``path``.

    The format is described in docs/reference/formats.md. Raises DyngsError: the scene is not an
    avatar, its template is missing, or the file cannot be written.
    """
    scene = as_human_scene(person)
    if scene is None or not isinstance(model, HumanModel):
        raise DyngsError(
            "--format avatar needs a run with model.kind=human, this one has "
            f"model.kind={model.kind}"
        )
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(f"{path}: the name of an avatar file must end in {SUFFIX}")
    if scene.colour is not None:
        raise DyngsError(
            "avatar files store spherical harmonics, but this run has a colour network; train with "
            "colour.kind=sh"
        )
    reference = scene.at_rest().replacement_clip
    assert reference is not None
    tensors = {
        name.removeprefix("model."): x
        for name, x in strip_roles(scene.drawing_state()).items()
        if name.startswith(("gaussians.", "model.anchors.", "model.shapes."))
    }
    tensors |= {
        "anchors.face": scene.anchors.face.int(),
        "anchors.joints": scene.anchors.joints.to(torch.uint8),
        "skeleton.joints": scene.learned_skeleton.joints,
        "skeleton.template_joints": scene.skeleton.joints,
        "skeleton.parents": torch.tensor(scene.skeleton.parents, device="cpu"),
        "fit.turns": scene.fit.turns,
        "fit.log_scale": torch.tensor([scene.fit.log_scale], device="cpu"),
        "reference.poses": reference.poses[0],
        "reference.trans": reference.trans[0],
        "reference.scale": reference.scale,
    }
    if scene.light is not None:
        tensors |= {"light": scene.light.factors, "normals": scene.light.normals}
    file = template_path(model)
    # Motions of other skeletons are retargeted with the template, so that the file names it.
    template = {"file": file.name, "sha256": _sha256(file), "packaged": model.body is None}
    header = {**asdict(info), "near": model.near, "eps2d": model.eps2d, "template": template}
    write_tensors(
        path, _KIND, {name: x.detach().contiguous() for name, x in tensors.items()}, header
    )
    return path


def read_avatar(path: Path) -> tuple[HumanModel, HumanScene, CheckpointInfo]:
    """Read an avatar file; return its config section, the scene in rest pose, and the metadata.

    A template other than the free one must lie next to the file; it is read when a motion needs it.
    Raises DyngsError: the file is missing, damaged, changed or no avatar, or the template next to
    it is a different one.
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
        reason = format_one_line(str(error), 120)
        if isinstance(error, KeyError):
            reason = f"{error.args[0]} is missing"
        raise DyngsError(f"{path}: not a valid avatar ({reason}){_ADVICE}") from None
    options = render_options(model, info.extent, info.world_scale)
    scene = replace(scene, options=options, background=background_colour(info.background))
    return model, scene, info


def _template_beside(path: Path, file: str, sha256: str, packaged: bool) -> Path | None:
    """Return the path of the template next to the avatar file ``path``; None: the free template."""
    name = Path(file).name
    if len(name) > _LONGEST_NAME:
        raise ValueError("the file name of its template is too long")
    template = template_path(HumanModel()) if packaged else path.parent / name
    if template.is_file() and _sha256(template) != sha256:
        other = "the free template of this version" if packaged else f"{template}"
        raise DyngsError(
            f"{path}: needs its own template '{file}', not {other}; copy that file next to it"
        )
    return None if packaged else template


def _sha256(file: Path) -> str:
    with wrap_read_errors(file, "it must be the body template; restore the file"):
        return hashlib.sha256(file.read_bytes()).hexdigest()


def _scene(tensors: Mapping[str, Tensor]) -> HumanScene:
    """Build the scene. Raises KeyError (missing tensor) or ValueError (type, shape or range)."""
    joints = tensors["skeleton.template_joints"]
    poses = tensors["reference.poses"][None]
    trans = tensors["reference.trans"][None]
    stored = dict(tensors) | {
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
