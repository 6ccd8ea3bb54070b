"""Avatar files: a trained person in one file, to be rendered in any pose without the run.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, M vertices and T triangles
of the template.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, printable
from dyngs.core.section import ModelSection
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import render_options
from dyngs.human.avatar.posing import TERMS, Anchors, PoseBlendShapes, Skeleton, new_corrections
from dyngs.human.avatar.scene import HumanScene, avatar_of, require_body, require_shapes
from dyngs.human.body.body_reader import template_path
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import MotionClip
from dyngs.io.tensor_file import FileKind, read_tensors, write_tensors
from dyngs.models.checkpoint import CheckpointInfo, info_of
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour

SUFFIX = ".safetensors"

_KIND = FileKind("dyngs avatar", "an avatar", 1)
_ADVICE = "; export it again with `dyngs export RUN --format avatar`"
_LONGEST_NAME = 200
"""Characters of the name of a file, which must have its place in every file system."""
_WEIGHT_SUM = 1e-3
"""Tolerance of the sum of skinning weights; rounding errors in float32 are below 1e-6."""


@dataclass(frozen=True)
class TemplateRef:
    """File and SHA-256 of the body template of an avatar, and whether it is the free one that comes
    with dyngs.

    It is needed only to retarget motions of other skeletons.
    """

    file: str
    sha256: str
    packaged: bool


def write_avatar(person: Renderable, model: ModelSection, info: CheckpointInfo, path: Path) -> Path:
    """Write a person, upright and at rest at the place of the capture (docs/formats.md); return
    ``path``.

    Raises DyngsError: the scene is not that of a person, its template is missing, or the file cannot
    be written.
    """
    # late: scipy, which reading an avatar does without
    from dyngs.human.motion.placement import rest_clip

    scene = avatar_of(person)
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
    template = TemplateRef(file.name, _sha256(file), model.body is None)
    header = {
        **asdict(info),
        "near": model.near,
        "eps2d": model.eps2d,
        "template": asdict(template),
    }
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
        _check(tensors)
        scene = _scene(tensors)
        info = info_of(header)
        model = HumanModel(
            body=_template_beside(path, TemplateRef(**header["template"])),
            near=header["near"],
            eps2d=header["eps2d"],
            rasterize_mode=RasterizeMode(info.rasterize_mode),
            sh_degree={1: 0, 4: 1}[scene.gaussians.sh.shape[1]],
        )
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        why = (
            f"{error.args[0]} is missing"
            if isinstance(error, KeyError)
            else printable(str(error), 120)
        )
        raise DyngsError(f"{path}: not a valid avatar ({why}){_ADVICE}") from None
    options = render_options(model, info.extent, info.world_scale)
    scene = replace(scene, options=options, background=background_colour(info.background))
    return model, scene, info


def _template_beside(path: Path, ref: TemplateRef) -> Path | None:
    """Return where the template of an avatar in ``path`` is or should be; None: the free one."""
    if len(Path(ref.file).name) > _LONGEST_NAME:
        raise ValueError("the name of its template is too long")
    file = template_path(HumanModel()) if ref.packaged else path.parent / Path(ref.file).name
    if file.is_file() and _sha256(file) != ref.sha256:
        whose = "that of this version of dyngs" if ref.packaged else f"{file}"
        raise DyngsError(
            f"{path}: needs its own template '{ref.file}', not {whose}; put that file beside it"
        )
    return None if ref.packaged else file


def _sha256(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise DyngsError(
            f"{file}: the template cannot be read ({error.strerror}); restore it"
        ) from None


def _check(tensors: Mapping[str, Tensor]) -> None:
    """Raises KeyError for a missing tensor, ValueError for a wrong type, shape or range."""
    n = len(tensors["gaussians.means"])
    j = len(tensors["skeleton.joints"])
    terms = tensors["gaussians.sh"].shape[1]
    k = tensors["anchors.joints"].shape[1]
    count = 2**31 - 1  # the faces of a template without shapes are not there
    gaussians = {
        "means": (n, 3),
        "quats": (n, 4),
        "log_scales": (n, 3),
        "logit_opacities": (n,),
        "sh": (n, terms, 3),
    }
    shapes: dict[str, tuple[int, ...]] = {
        f"gaussians.{name}": shape for name, shape in gaussians.items()
    }
    anchors = {
        "points": (n, 3),
        "size": (n,),
        "barycentric": (n, 3),
        "uv": (n, 2),
        "height": (n,),
        "weights": (n, k),
    }
    shapes |= {f"anchors.{name}": shape for name, shape in anchors.items()}
    shapes |= dict.fromkeys(
        ("skeleton.joints", "skeleton.template_joints", "fit.turns", "reference.poses"), (j, 3)
    )
    shapes |= {"fit.log_scale": (1,), "reference.trans": (3,), "reference.scale": (1,)}
    if "light" in tensors:
        shapes |= {"light": (TERMS, 3), "normals": (n, 3)}
    if not n:
        raise ValueError("there are no Gaussians")
    for name, shape in shapes.items():
        require_tensor(name, tensors[name], shape)
    require_body(n, terms, tensors["skeleton.parents"], j)
    if "shapes.directions" in tensors:
        count = len(tensors["shapes.faces"])
        require_shapes(tensors["shapes.directions"], tensors["shapes.faces"], j)
    require_indices("anchors.face", tensors["anchors.face"], (n,), count, torch.int32)
    require_indices("anchors.joints", tensors["anchors.joints"], (n, k), j, torch.uint8)
    require_positive("reference.scale", tensors["reference.scale"])
    weights = tensors["anchors.weights"]
    if bool((weights < 0).any()) or bool(((weights.sum(1) - 1).abs() > _WEIGHT_SUM).any()):
        raise ValueError("the skinning weights of a Gaussian are negative or do not sum to 1")


def _scene(tensors: Mapping[str, Tensor]) -> HumanScene:

    def part(prefix: str) -> dict[str, Any]:
        return {
            name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)
        }

    own = part("anchors.")
    anchors = Anchors(**{**own, "face": own["face"].long(), "joints": own["joints"].long()})
    parents = tuple(tensors["skeleton.parents"].tolist())
    reference = MotionClip(
        times=torch.zeros(1, dtype=torch.float64, device="cpu"),
        poses=tensors["reference.poses"][None],
        trans=tensors["reference.trans"][None],
        scale=tensors["reference.scale"],
    )
    shapes = part("shapes.")
    given = tensors["skeleton.template_joints"]
    skeleton = Skeleton(given, parents)
    values = {
        "poses": torch.zeros_like(reference.poses),
        "trans": torch.zeros_like(reference.trans),
        "turns": tensors["fit.turns"],
        "joints": tensors["skeleton.joints"] - given,
        "log_scale": tensors["fit.log_scale"],
        "weights": torch.zeros_like(anchors.weights),
    }
    values |= {name: tensors[name] for name in ("light", "normals") if name in tensors}
    return HumanScene(
        gaussians=Gaussians.stored(Gaussians(**part("gaussians.")).tensors()),  # and nothing else
        anchors=anchors,
        skeleton=skeleton,
        clip=reference,
        learned=new_corrections(reference, skeleton, anchors, tensors.get("normals")).restored(
            values
        ),
        shapes=PoseBlendShapes(shapes["directions"].float(), shapes["faces"].long())
        if shapes
        else None,
    )
