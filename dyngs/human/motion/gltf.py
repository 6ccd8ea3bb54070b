"""Reader of the skeletal animation of glTF 2.0 files (``.glb``, ``.gltf``).

Local letters: S joints of the skin, F frames, K keys of a channel.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, TypeVar
from urllib.parse import unquote

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, PositiveInt, ValidationError
from scipy.spatial.transform import Rotation

from dyngs.errors import DyngsError, reading
from dyngs.files.limits import require_at_most
from dyngs.human.motion.motion import frame_chunks, require_frame_count, sample_times
from dyngs.human.motion.skeleton_motion import SkeletonMotion

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}

_MOST_PARTS = 1 << 16
"""Nodes, accessors, channels and the like."""
_MOST_JOINTS = 4096
_MOST_KEYS = 1 << 25
"""Numbers of all curves together: 100 joints that turn, move and stretch in 30,000 keys."""

_Number = Annotated[FiniteFloat, Field(ge=-1e9, le=1e9)]
_Three = Annotated[tuple[_Number, ...], Field(min_length=3, max_length=3)]
_Four = Annotated[tuple[_Number, ...], Field(min_length=4, max_length=4)]
_Sixteen = Annotated[tuple[_Number, ...], Field(min_length=16, max_length=16)]


_T = TypeVar("_T")
_Parts = Annotated[tuple[_T, ...], Field(max_length=_MOST_PARTS)]


class _Part(BaseModel):
    """Fields of the standard that matter here; all else is ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _Buffer(_Part):
    byteLength: PositiveInt
    uri: str | None = None


class _View(_Part):
    buffer: NonNegativeInt
    byteLength: PositiveInt
    byteOffset: NonNegativeInt = 0
    byteStride: PositiveInt | None = None
    extensions: dict[str, object] = {}


class _Accessor(_Part):
    componentType: int
    count: PositiveInt
    type: str
    bufferView: NonNegativeInt | None = None
    byteOffset: NonNegativeInt = 0
    sparse: object = None


class _Node(_Part):
    name: str = ""
    children: _Parts[NonNegativeInt] = ()
    matrix: _Sixteen | None = None
    translation: _Three = (0.0, 0.0, 0.0)
    rotation: _Four = (0.0, 0.0, 0.0, 1.0)
    scale: _Three = (1.0, 1.0, 1.0)


class _Skin(_Part):
    joints: Annotated[tuple[NonNegativeInt, ...], Field(min_length=1, max_length=_MOST_JOINTS)]
    inverseBindMatrices: NonNegativeInt | None = None


class _Target(_Part):
    path: str
    node: NonNegativeInt | None = None


class _Channel(_Part):
    sampler: NonNegativeInt
    target: _Target


class _Sampler(_Part):
    input: NonNegativeInt
    output: NonNegativeInt
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class _Animation(_Part):
    channels: _Parts[_Channel]
    samplers: _Parts[_Sampler]
    name: str = ""


class _Asset(_Part):
    version: Annotated[str, Field(pattern=r"^2\.")]


class _Document(_Part):
    asset: _Asset
    nodes: _Parts[_Node] = ()
    skins: _Parts[_Skin] = ()
    animations: _Parts[_Animation] = ()
    accessors: _Parts[_Accessor] = ()
    bufferViews: _Parts[_View] = ()
    buffers: _Parts[_Buffer] = ()


@dataclass(frozen=True)
class _Curve:
    """How one property of a node changes: K ascending times, s, and K values, or 3 K of a cubic spline."""

    times: np.ndarray
    values: np.ndarray
    interpolation: str


@dataclass(frozen=True)
class _Frames:
    """A node in the world: linear part and rotation (F, 3, 3), position (F, 3)."""

    linear: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray


def read_gltf(path: Path, fps: float = 30.0, clip: str | None = None) -> SkeletonMotion:
    """The motion of the joints of the file's largest skin at ``fps`` frames per second, from the first key to the last.

    Rest is the bind pose, inverse(inverseBindMatrices), or where there are none the nodes as they stand. The world is
    that of the scene: y up. The rotation of a joint is the product of those of its nodes, so scale does not shear it.

    Args:
        clip: name of the animation; needed if several move the skin.

    Raises:
        DyngsError: no skin, no such animation, anything broken or not supported (sparse accessors, meshopt compression,
            mirrored nodes); names the file.
    """
    with reading(path):
        return _motion(_File(path), fps, clip)


def _motion(file: _File, fps: float, clip: str | None) -> SkeletonMotion:
    joints = max((skin.joints for skin in file.document.skins), key=len, default=())
    if not joints:
        raise file.error("has no skin, hence no skeleton; export it with its skinned mesh")
    chain = _with_ancestors(file, joints)
    curves = _curves(file, _chosen(file, chain, clip), chain)
    start, end = min(c.times[0] for c in curves.values()), max(c.times[-1] for c in curves.values())
    require_frame_count(file.path, float((end - start) * fps), len(chain))
    times = start + sample_times(end - start, 1.0, fps)
    rotations = np.empty((len(times), len(joints), 3, 3))
    positions = np.empty((len(times), len(joints), 3))
    for part in frame_chunks(len(times)):
        moving = _placed(file, chain, curves, times[part])
        for i, node in enumerate(joints):
            rotations[part, i], positions[part, i] = moving[node].rotations, moving[node].positions
    if not (np.abs(positions) < 1e9).all():
        raise file.error("its joints go beyond all bounds; export it again")
    bind = next(skin.inverseBindMatrices for skin in file.document.skins if skin.joints == joints)
    if bind is None:
        still = _placed(file, chain, {}, np.zeros(1))
        rest = np.stack([still[node].positions[0] for node in joints])
        rest_from_joint = np.stack([still[node].rotations[0] for node in joints])
    else:
        rest, rest_from_joint = _bind_pose(file, bind, len(joints))
    for part in frame_chunks(len(times)):
        rotations[part] = rotations[part] @ rest_from_joint.swapaxes(1, 2)
    return SkeletonMotion(
        file.path,
        tuple(file.document.nodes[node].name for node in joints),
        rest,
        rotations,
        positions,
        fps,
        world_is_y_up=True,
    )


class _File:
    """The document of a file, and the numbers that it refers to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self._attached = _chunks(path)
        try:
            self.document = _Document.model_validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "JSON"
            raise self.error(f"{where}: {first['msg']:.100}; export it again") from None
        self._buffers: dict[str | None, bytes] = {}
        self._read: dict[int, np.ndarray] = {}
        self._keys = 0

    def error(self, problem: str) -> DyngsError:
        """What to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def numbers(self, index: int, kind: str) -> np.ndarray:
        """(K, D) finite float64 of an accessor; integers as they are, as only quaternions may be integers here.

        Raises:
            DyngsError: it has another type than ``kind``, or lies outside its buffer.
        """
        document = self.document
        if index >= len(document.accessors):
            raise self.error(f"accessor {index} is missing; export it again")
        accessor = document.accessors[index]
        if accessor.type != kind or accessor.componentType not in _TYPES:
            raise self.error(f"accessor {index} must hold {kind}, not {accessor.type[:20]!r}; export it again")
        if accessor.bufferView is None or accessor.sparse is not None:
            raise self.error(f"accessor {index} is sparse or has no data; export it with plain accessors")
        if accessor.bufferView >= len(document.bufferViews):
            raise self.error(f"accessor {index} refers to a missing buffer view; export it again")
        view = document.bufferViews[accessor.bufferView]
        if any("compression" in name for name in view.extensions):
            raise self.error(f"accessor {index} is compressed; export it without compression")
        data = memoryview(self._buffer(view.buffer))[view.byteOffset : view.byteOffset + view.byteLength]
        dtype, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[kind]
        stride = view.byteStride or width * dtype.itemsize
        needed = accessor.byteOffset + stride * (accessor.count - 1) + width * dtype.itemsize
        if len(data) < view.byteLength or len(data) < needed:
            raise self.error(f"accessor {index} lies outside its buffer; the file is cut off or broken")
        self._keys += accessor.count * width
        require_at_most(self.path, self._keys, _MOST_KEYS, "numbers of keys")
        if index in self._read:
            return self._read[index]
        shape, strides = (accessor.count, width), (stride, dtype.itemsize)
        with np.errstate(invalid="ignore"):  # of NaN, which is refused below
            values = np.ndarray(shape, dtype, data, accessor.byteOffset, strides).astype(np.float64)
        if not (np.abs(values) < 1e9).all():
            raise self.error(f"accessor {index} holds NaN or huge numbers; export it again")
        self._read[index] = values
        return values

    def rotations(self, quats: np.ndarray) -> Rotation:
        """The rotations of quaternions (F, 4) xyzw of any length.

        Raises:
            DyngsError: one of them is zero.
        """
        largest = np.abs(quats).max(axis=1, keepdims=True)
        if (largest == 0).any():
            raise self.error("a rotation is a quaternion of zeros; export it again")
        return Rotation.from_quat(quats / largest)

    def _buffer(self, index: int) -> bytes:
        if index >= len(self.document.buffers):
            raise self.error(f"buffer {index} is missing; export it again")
        uri = self.document.buffers[index].uri
        if uri not in self._buffers:
            self._buffers[uri] = self._attached if uri is None else self._fetched(uri)
        return self._buffers[uri]

    def _fetched(self, uri: str) -> bytes:
        """The bytes of a data URI, or of a file in the same folder or below."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(";base64,")[2], validate=True)
            except binascii.Error:
                raise self.error("an embedded buffer is not base64; export it again") from None
        name = unquote(uri)
        parts = PurePosixPath(name).parts
        if not parts or ".." in parts or PurePosixPath(name).is_absolute() or set(name) & {":", "\\", "\0"}:
            raise self.error(f"its buffer {name[:60]!r} is not a file beside it; export it as .glb")
        beside = self.path.parent / name
        if beside.exists() and not beside.is_file():
            raise self.error(f"its buffer {name[:60]!r} is no file; export it as .glb")
        try:
            return beside.read_bytes()
        except OSError as error:
            raise self.error(f"its buffer {name[:60]!r} cannot be read ({error.strerror})") from error


def _chunks(path: Path) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a ``.glb``; a ``.gltf`` is all JSON."""
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is no file; name a .glb or a .gltf")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror})") from error
    if content[:4] != b"glTF":
        return content.removeprefix(b"\xef\xbb\xbf"), b""
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(content):
        size, kind = int.from_bytes(content[start : start + 4], "little"), content[start + 4 : start + 8]
        if start + 8 + size > len(content):
            raise DyngsError(f"{path}: is cut off; copy or export it again")
        found.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in found:
        raise DyngsError(f"{path}: holds no JSON chunk of glTF 2.0; export it again")
    return found[b"JSON"], found.get(b"BIN\0", b"")


def _with_ancestors(file: _File, joints: tuple[int, ...]) -> dict[int, int | None]:
    """The parent of each joint and of all nodes above, parents first."""
    nodes = file.document.nodes
    parents: dict[int, int] = {}
    for i, owner in enumerate(nodes):
        for child in owner.children:
            if child >= len(nodes) or child in parents:
                raise file.error(f"node {child} is missing or has two parents; export it again")
            parents[child] = i
    chain: dict[int, int | None] = {}
    for joint in joints:
        if joint >= len(nodes):
            raise file.error(f"the skin's joint {joint} is missing; export it again")
        above: list[int] = []
        node: int | None = joint
        while node is not None and node not in chain:
            above.append(node)
            node = parents.get(node)
            if len(above) > len(nodes):
                raise file.error(f"node {joint} is its own ancestor; export it again")
        chain.update((x, parents.get(x)) for x in reversed(above))
    return chain


def _chosen(file: _File, chain: dict[int, int | None], clip: str | None) -> _Animation:
    """The animation of that name, or the only one that moves a node of the chain."""
    moving = [a for a in file.document.animations if any(c.target.node in chain for c in a.channels)]
    named = [a for a in moving if clip in (None, a.name)]
    names = ", ".join(repr(a.name[:30]) for a in moving[:20])
    if not moving:
        raise file.error("no animation moves its skin; export it with the animation")
    if not named:
        raise file.error(f"has no animation {clip!r}; it has {names}")
    if clip is None and len(named) > 1:
        raise file.error(f"has several animations; choose a clip of {names}")
    return named[0]


def _curves(file: _File, animation: _Animation, chain: dict[int, int | None]) -> dict[tuple[int, str], _Curve]:
    """What changes of the nodes of the chain, by node and property."""
    curves: dict[tuple[int, str], _Curve] = {}
    for channel in animation.channels:
        node, kind = channel.target.node, channel.target.path
        if node is None or node not in chain or kind not in _KINDS:
            continue
        if channel.sampler >= len(animation.samplers):
            raise file.error(f"the animation {animation.name[:30]!r} lacks a sampler; export it again")
        if file.document.nodes[node].matrix is not None:
            raise file.error(f"node {node} is animated but has a matrix; export it again")
        sampler = animation.samplers[channel.sampler]
        times, values = file.numbers(sampler.input, "SCALAR")[:, 0], file.numbers(sampler.output, _KINDS[kind])
        if len(values) != len(times) * (3 if sampler.interpolation == "CUBICSPLINE" else 1):
            raise file.error(f"a {kind} of node {node} has {len(times)} times but {len(values)} values")
        if (np.diff(times) < 0).any():
            raise file.error(f"the times of a {kind} of node {node} do not ascend; export it again")
        curves[node, kind] = _Curve(times, values, sampler.interpolation)
    if not curves:
        raise file.error(f"the animation {animation.name[:30]!r} turns or moves no joint; choose another")
    return curves


def _placed(
    file: _File, chain: dict[int, int | None], curves: dict[tuple[int, str], _Curve], times: np.ndarray
) -> dict[int, _Frames]:
    """The nodes of the chain in the world at ``times`` (F,)."""
    placed: dict[int, _Frames] = {}
    for index, parent in chain.items():
        local = _local(file, index, curves, times)
        if parent is None:
            placed[index] = local
            continue
        above = placed[parent]
        position = above.positions + (above.linear @ local.positions[..., None])[..., 0]
        placed[index] = _Frames(above.linear @ local.linear, above.rotations @ local.rotations, position)
    return placed


def _local(file: _File, index: int, curves: dict[tuple[int, str], _Curve], times: np.ndarray) -> _Frames:
    """A node relative to its parent: T R S, or its matrix."""
    node, frames = file.document.nodes[index], len(times)
    if node.matrix is not None:
        matrix = np.array(node.matrix).reshape(4, 4).T
        rotation = _rotation_of(file, matrix[None, :3, :3])
        still = (matrix[:3, :3], rotation[0], matrix[:3, 3])
        return _Frames(*(np.broadcast_to(x, (frames, *x.shape)) for x in still))
    values: dict[str, np.ndarray] = {}
    for kind in _KINDS:
        curve = curves.get((index, kind))
        fixed = np.tile(np.array(getattr(node, kind)), (frames, 1))
        values[kind] = fixed if curve is None else _sampled(file, curve, times)
    rotation = file.rotations(values["rotation"]).as_matrix()
    if (values["scale"].prod(axis=1) < 0).any():
        raise file.error(f"node {index} is mirrored; export it without negative scale")
    return _Frames(rotation * values["scale"][:, None], rotation, values["translation"])


def _sampled(file: _File, curve: _Curve, times: np.ndarray) -> np.ndarray:
    """(F, 3) or (F, 4) values at ``times`` (F,); before the first and after the last key those of that key."""
    slack = 1e-4 if curve.interpolation == "STEP" else 0.0  # keys are float32: a step must not be missed by rounding
    after = np.searchsorted(curve.times, times + slack, side="right")
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(curve.times) - 1)
    span = curve.times[after] - curve.times[before]
    share = ((times - curve.times[before]) / np.where(span > 0, span, 1.0))[:, None]
    if curve.interpolation == "CUBICSPLINE":
        arriving, keys, leaving = curve.values.reshape(len(curve.times), 3, -1).transpose(1, 0, 2)
        ease = share * share * (3 - 2 * share)
        bend = span[:, None] * share * (1 - share) * ((1 - share) * leaving[before] - share * arriving[after])
        return keys[before] + ease * (keys[after] - keys[before]) + bend
    if curve.interpolation == "STEP":
        return curve.values[before]
    start, end = curve.values[before], curve.values[after]
    if start.shape[1] == 3:
        return start + share * (end - start)
    turned = file.rotations(start)
    return (turned * Rotation.from_rotvec(share * (turned.inv() * file.rotations(end)).as_rotvec())).as_quat()


def _bind_pose(file: _File, index: int, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, 3) joints and (S, 3, 3) rest_from_joint of the bind pose."""
    matrices = file.numbers(index, "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)[:joints]
    if len(matrices) < joints:
        raise file.error(f"has {len(matrices)} inverse bind matrices for {joints} joints; export it again")
    joint_from_rest = _rotation_of(file, matrices[:, :3, :3])
    rest = -np.linalg.solve(matrices[:, :3, :3], matrices[:, :3, 3:])[..., 0]
    return rest, joint_from_rest.swapaxes(1, 2)


def _rotation_of(file: _File, linear: np.ndarray) -> np.ndarray:
    """(S, 3, 3) nearest rotations: U V^T of the singular value decomposition U D V^T."""
    left, stretch, right = np.linalg.svd(linear)
    if (stretch[:, 2] <= 1e-9 * stretch[:, 0]).any() or (np.linalg.det(left @ right) < 0).any():
        raise file.error("a matrix is flat or mirrored; export it without negative scale")
    return left @ right
