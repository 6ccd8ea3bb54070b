"""A person in one file: everything that holds in all poses, to be drawn and moved where the run is not.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, M vertices and T triangles of the template.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, HumanModel
from dyngs.config.kinds import person_of
from dyngs.conventions import RasterizeMode
from dyngs.errors import DyngsError
from dyngs.files.tensor_file import FileKind, read_tensors, write_tensors
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.corrections import new_corrections
from dyngs.human.avatar.posing import PoseBlendShapes, Skeleton
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.human.motion.clip import MotionClip
from dyngs.human.motion.placement import rest_clip
from dyngs.human.pose.skinning import check_tree
from dyngs.human.template.joints import SMPLX_ROWS
from dyngs.human.template.load import template_path
from dyngs.runs.checkpoint import LoadedRun, info_of

SUFFIX = ".safetensors"

_KIND = FileKind("dyngs avatar", "an avatar", 1)
_ADVICE = "; export it again with `dyngs export RUN --format avatar`"
_SHARE_SUM = 1e-3
"""What skinning weights may miss of 1; in float32 they miss less than 1e-6."""


@dataclass(frozen=True)
class TemplateRef:
    """Which body template an avatar is built on; it is needed only to bring it motions of other skeletons.

    Attributes:
        file: name of the template's file, without folders.
        sha256: of the file's bytes.
        packaged: it is the free template that comes with dyngs.
    """

    file: str
    sha256: str
    packaged: bool


def write_avatar(run: LoadedRun, path: Path) -> Path:
    """``path`` of the file written: the person of a run, upright and at rest where it was filmed; docs/formats.md.

    Raises:
        DyngsError: the run is not one of a person, its template is gone, or the file cannot be written.
    """
    scene, model = avatar_of(run.scene), person_of(run.config)
    if scene is None or model is None:
        raise DyngsError(
            f"--format avatar needs the run of a person (model.kind=human), this one is {run.config.model.kind}"
        )
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(f"{path}: an avatar is written as {SUFFIX}")
    if scene.colour is not None:
        raise DyngsError("an avatar file holds harmonics, this run's colours are a network; train with colour.kind=sh")
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
        "skeleton.parents": torch.tensor(scene.skeleton.parents),
        "fit.turns": scene.fit.turns,
        "fit.log_scale": torch.tensor([scene.fit.log_scale]),
        "reference.poses": reference.poses[0],
        "reference.trans": reference.trans[0],
        "reference.scale": reference.scale,
    }
    if scene.shapes is not None:
        tensors |= {"shapes.directions": scene.shapes.directions.half(), "shapes.faces": scene.shapes.faces.int()}
    if scene.pose_dirs is not None:
        tensors["pose_dirs"] = scene.pose_dirs
    header = {**asdict(run.info), "near": model.near, "eps2d": model.eps2d, "template": asdict(_template_ref(model))}
    write_tensors(path, _KIND, {name: x.detach().contiguous() for name, x in tensors.items()}, header)
    return path


def read_avatar(path: Path) -> LoadedRun:
    """The person of a file, upright and at rest; ``dyngs.view.animation`` moves it as it does one of a run.

    The template of an avatar that is not built on the free one is looked for beside the file when a motion needs it.

    Raises:
        DyngsError: the file is missing, damaged, altered or no avatar, or the template beside it is another one.
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
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise DyngsError(f"{path}: no proper avatar ({_reason(error)}){_ADVICE}") from None
    return LoadedRun(Config(data=DataConfig(root=path), model=model), scene, info.step, 0.0, info)


def _template_ref(model: HumanModel) -> TemplateRef:
    file = template_path(model)
    return TemplateRef(file.name, _sha256(file), model.body is None)


def _template_beside(path: Path, ref: TemplateRef) -> Path | None:
    """Where the template of an avatar in ``path`` is or should be; None is the free one."""
    file = template_path(HumanModel()) if ref.packaged else path.parent / Path(ref.file).name
    if file.is_file() and _sha256(file) != ref.sha256:
        whose = "that of this version of dyngs" if ref.packaged else f"{file}"
        raise DyngsError(f"{path}: was built on another template '{ref.file}' than {whose}; give the file of that name")
    return None if ref.packaged else file


def _sha256(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise DyngsError(f"{file}: the template cannot be read ({error.strerror}); restore it") from None


def _check(tensors: Mapping[str, Tensor]) -> None:
    """Raises ValueError or KeyError where something lacks, or has another type, shape or range than it must."""
    n, (j, _) = len(tensors["gaussians.means"]), tensors["skeleton.joints"].shape
    k, terms = tensors["anchors.joints"].shape[1], tensors["gaussians.sh"].shape[1]
    per_gaussian = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (terms, 3)}
    per_anchor = {"points": (3,), "size": (), "barycentric": (3,), "uv": (2,), "height": (), "weights": (k,)}
    shapes: dict[str, tuple[int, ...]] = {f"gaussians.{name}": (n, *shape) for name, shape in per_gaussian.items()}
    shapes |= {f"anchors.{name}": (n, *shape) for name, shape in per_anchor.items()}
    shapes |= {"anchors.face": (n,), "anchors.joints": (n, k), "skeleton.parents": (j,)}
    shapes |= {
        "skeleton.joints": (j, 3),
        "skeleton.template_joints": (j, 3),
        "fit.turns": (j, 3),
        "fit.log_scale": (1,),
    }
    shapes |= {"reference.poses": (j, 3), "reference.trans": (3,), "reference.scale": (1,)}
    optional: dict[str, tuple[int, ...]] = {"pose_dirs": (n, 27)}
    if "shapes.directions" in tensors:
        faces, directions = tensors["shapes.faces"], tensors["shapes.directions"]
        optional |= {"shapes.faces": (len(faces), 3), "shapes.directions": (9 * (j - 1), directions.shape[1])}
        _require_index("shapes.faces", faces, directions.shape[1] // 3)
        _require_index("anchors.face", tensors["anchors.face"], len(faces))
    integers = ("anchors.face", "anchors.joints", "skeleton.parents", "shapes.faces")
    for name, shape in (shapes | {x: s for x, s in optional.items() if x in tensors}).items():
        tensor = tensors[name]
        if tuple(tensor.shape) != shape or tensor.is_floating_point() == (name in integers):
            raise ValueError(f"'{name}' is {tensor.dtype} {tuple(tensor.shape)}, not {shape}")
        if name not in integers and not bool(tensor.isfinite().all()):
            raise ValueError(f"'{name}' holds NaN or infinite numbers")
    if j not in SMPLX_ROWS or terms not in (1, 4) or not n:
        raise ValueError(f"{n} Gaussians of {terms} harmonics on {j} joints")
    check_tree(tuple(tensors["skeleton.parents"].tolist()))
    _require_index("anchors.joints", tensors["anchors.joints"], j)
    weights = tensors["anchors.weights"]
    if bool((weights < 0).any()) or bool(((weights.sum(1) - 1).abs() > _SHARE_SUM).any()):
        raise ValueError("the skinning weights of a Gaussian are no shares of 1")
    if not bool((tensors["reference.scale"] > 0).all()):
        raise ValueError("the size is not positive")


def _require_index(name: str, index: Tensor, count: int) -> None:
    if bool(((index < 0) | (index >= count)).any()):
        raise ValueError(f"'{name}' names something beyond the {count} that there are")


def _scene(tensors: Mapping[str, Tensor]) -> HumanScene:
    """The person of checked tensors."""

    def part(prefix: str) -> dict[str, Any]:
        return {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}

    own = part("anchors.")
    anchors = Anchors(**{**own, "face": own["face"].long(), "joints": own["joints"].long()})
    parents = tuple(tensors["skeleton.parents"].tolist())
    reference = MotionClip(
        times=torch.zeros(1, dtype=torch.float64),
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
    values |= {name: tensors[name] for name in ("pose_dirs",) if name in tensors}
    options = HumanModel(pose_offsets="pose_dirs" in tensors)
    return HumanScene(
        gaussians=Gaussians(**part("gaussians.")),
        anchors=anchors,
        skeleton=skeleton,
        clip=reference,
        learned=new_corrections(options, reference, skeleton, anchors).restored(values),
        shapes=PoseBlendShapes(shapes["directions"].float(), shapes["faces"].long()) if shapes else None,
    )


def _reason(error: Exception) -> str:
    return f"{error.args[0]} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())[:120]
