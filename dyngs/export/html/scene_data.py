"""Packed scene data of a page: Gaussians, motion, colours or triangles; read by ``data.js``.

Motion is stored as splines of drivers. A driver is a control node that several Gaussians follow, or
a single Gaussian if the field has no nodes.

Local letters: N Gaussians, M moving ones, J joints, F frames of a clip; R rows and D columns of an
array; S drivers, P control points, B drivers per Gaussian.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyngs.core.gaussians import storage_order
from dyngs.deform.control_nodes import FOLLOWED, ControlNodes, spline_basis
from dyngs.deform.field import DeformationField, Offsets
from dyngs.deform.fields import EDGE_WIDTH, OPEN_WINDOW, WindowedField
from dyngs.deform.free import FreePrimitives
from dyngs.deform.gaussians_4d import MIN_WEIGHT, Gaussians4D
from dyngs.deform.scene import DynamicScene, field_scene_of
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import ColourNetwork
from dyngs.gaussians.levels import BLOCK, MAX_SPREAD_PX, MERGED, Block, Levels
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.scene import HumanScene, as_human_scene
from dyngs.ops.nodes import SPAN

BONES = 8  # Joints per Gaussian on the page
FINE = ("means", "quats")  # Splines of nodes that are stored with 16 bits
MAX_LOGIT = 15.0  # Opacity logits are clamped to this value, which is 1 to seven digits
CHUNK_BYTES = 1 << 19  # Bytes of splines fetched at once, before compression
CHUNK = 256  # Rows that share a quantisation range per column; neighbouring rows are close in space


class PackedArrays:
    """A block of bytes of several arrays, and their layout.

    Attributes:
        layout: kind, size and offset of each array, by name.
        chunks: splines that are fetched while playing, of one layout. None keeps everything in the
            block.
    """

    def __init__(self, *, chunked: bool = False) -> None:
        self.chunks: list[PackedArrays] | None = [] if chunked else None
        self.layout: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def quantised(self, name: str, values: NDArray[np.float32], bits: Literal[8, 16]) -> None:
        """Add ``values`` (R, D) with 8 or 16 bits: low + step * q, per chunk and column.

        The error is at most half a step: the range of the chunk over 510 or 131,070.
        """
        rows, columns = values.shape
        count = -(-rows // CHUNK)
        filled = np.pad(values, ((0, count * CHUNK - rows), (0, 0)), mode="edge")
        chunks = filled.reshape(count, CHUNK, columns).astype(np.float64)
        low = chunks.min(axis=1)
        step = ((chunks.max(axis=1) - low) / (2**bits - 1)).astype(np.float32)
        relative = (chunks - low[:, None]) / np.where(step > 0, step, 1)[:, None]
        quantised = relative.round().clip(0, 2**bits - 1).astype(np.uint16)
        quantised = quantised.reshape(-1, columns)[:rows]
        planes = [quantised >> 8, quantised & 255] if bits == 16 else [quantised]
        # (D, planes, R)
        bytes_of = np.stack([plane.T.astype(np.uint8) for plane in planes], axis=1)
        ranges = np.stack([low, step], axis=2).astype("<f4")
        data = ranges.tobytes() + bytes_of.tobytes()
        self._add(name, data, "quantised", values.shape, bits=bits, chunk=CHUNK)

    def exact(self, name: str, values: NDArray[Any]) -> None:
        """Add ``values`` (R, D) uint8, uint16 or float32 without quantisation."""
        data = values.astype(values.dtype.newbyteorder("<")).tobytes()
        self._add(name, data, values.dtype.name, values.shape)

    def deflated(self) -> bytes:
        """Return the block compressed by zlib."""
        return zlib.compress(b"".join(self._parts), 9)

    def text(self) -> str:
        """Return the compressed block in base64."""
        return base64.b64encode(self.deflated()).decode("ascii")

    def _add(self, name: str, data: bytes, kind: str, shape: tuple[int, ...], **more: int) -> None:
        rows, columns = shape
        place = {"kind": kind, "rows": rows, "columns": columns, "at": self._size}
        self.layout[name] = place | more
        self._parts.append(data)
        self._size += len(data)


def add_scene(scene: GaussianScene, lists: PackedArrays, tolerance: float) -> dict[str, Any]:
    """Add the data of a scene to ``lists``. Return the header fields of the page.

    Args:
        tolerance: position error in world units up to which motion is fitted.
    """
    person = as_human_scene(scene)
    moved = field_scene_of(scene)
    gaussians = scene.gaussians
    if person is not None:
        moving = torch.arange(len(scene), device="cpu")
    elif moved is not None:
        moving = moved.moving
    else:
        gaussians = scene.at(None)
        moving = torch.zeros(0, dtype=torch.long, device="cpu")
    order = torch.from_numpy(storage_order(_numpy(gaussians.means), moving.numpy()))
    header: dict[str, Any] = {"count": len(scene), "frames": len(scene.times)}
    header["moves"] = not scene.is_static
    if person is not None:
        header |= _add_person(person, order, lists, tolerance)
    elif moved is not None:
        motion, gaussians = _add_motion(moved, order, lists, tolerance)
        header |= motion
    gaussians = gaussians.select(order).detach()
    if scene.colour is not None:
        gaussians = gaussians.replace(sh=gaussians.sh[:, :1])
        header |= _add_network(scene.colour, lists)
    return header | _add_gaussians(gaussians, lists)


def add_levels(levels: Levels, colour: ColourNetwork | None, lists: PackedArrays) -> dict[str, Any]:
    """Add the block bounds of ``levels`` and a colour network. Return the header fields of the
    page.

    The page fetches the blocks itself, see ``block_numbers``.
    """
    lists.exact("blocks", np.concatenate(levels.blocks).astype(np.float32))
    coarsest = block_numbers(levels, (len(levels.levels) - 1, 0))
    sizes = [len(level) for level in levels.levels]
    known = {"sizes": sizes, "block": BLOCK, "merged": MERGED, "pixels": MAX_SPREAD_PX}
    header: dict[str, Any] = {"count": sizes[0], "frames": 0, "moves": False}
    header["degree"] = levels.levels[0].sh_degree
    header["levels"] = known | {"layout": coarsest.layout}
    return header if colour is None else header | _add_network(colour, lists)


def block_numbers(levels: Levels, block: Block) -> PackedArrays:
    """Return the arrays of a block with ``BLOCK`` rows. Missing rows are padded with transparent
    Gaussians."""
    gaussians = levels.block_gaussians(block)
    rows = torch.arange(BLOCK, device="cpu").clamp_max(len(gaussians) - 1)
    padded = gaussians.select(rows)
    padded.logit_opacities[len(gaussians) :] = -MAX_LOGIT
    lists = PackedArrays()
    _add_gaussians(padded, lists)
    return lists


def block_files(levels: Levels) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of the files of all blocks, as requested by ``levels.js``."""
    for level, balls in enumerate(levels.blocks):
        for place in range(len(balls)):
            yield f"{level}-{place}.bin", block_numbers(levels, (level, place)).deflated()


def _add_gaussians(gaussians: Gaussians, lists: PackedArrays) -> dict[str, Any]:
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    logits = gaussians.logit_opacities.clamp(-MAX_LOGIT, MAX_LOGIT)
    lists.quantised("means", _numpy(gaussians.means), 16)
    lists.quantised("quats", _numpy(torch.where(unit[:, :1] < 0, -unit, unit)), 8)
    lists.quantised("log_scales", _numpy(gaussians.log_scales), 8)
    lists.quantised("logit_opacities", _numpy(logits[:, None]), 8)
    lists.quantised("base", _numpy(gaussians.sh[:, 0]), 8)
    if gaussians.sh_degree:
        lists.quantised("rest", _numpy(gaussians.sh[:, 1:].flatten(1)), 8)
    return {"degree": gaussians.sh_degree}


def _add_motion(
    scene: DynamicScene, order: Tensor, lists: PackedArrays, tolerance: float
) -> tuple[dict[str, Any], Gaussians]:
    """Add the motion of a scene whose Gaussians are stored in ``order``, moving ones first.

    Returns the header fields and the Gaussians that the motion applies to.
    """
    gaussians = scene.gaussians
    if scene.field is None:
        return {}, gaussians
    place = torch.full((len(scene),), -1, device="cpu")
    place[scene.moving] = torch.arange(len(scene.moving), device="cpu")
    mine = place[order[: len(scene.moving)]]
    header: dict[str, Any] = {}
    if isinstance(scene.field, Gaussians4D):
        header["lines"], gaussians = _add_lines(scene, scene.field, mine, lists)
    else:
        means = gaussians.means[scene.moving]
        curves = motion_splines(scene.field, means, len(scene.times), tolerance)
        header["curves"] = _add_curves(curves, mine, lists)
    if scene.filter_std is not None:
        lists.quantised("filter_std", _numpy(scene.filter_std[order][:, None]), 8)
        header["filtered"] = True
    if scene.masks is not None:
        masks = scene.masks.select(order)
        lists.exact("masks", masks.bits.numpy())
        header["masks"] = {"times": list(masks.times)}
    return header, gaussians


def _add_lines(
    scene: DynamicScene, field: Gaussians4D, order: Tensor, lists: PackedArrays
) -> tuple[dict[str, Any], Gaussians]:
    """Add lines, opacities and colours over time of 4D Gaussians in ``order`` (M,).

    Returns the header fields and all Gaussians with the covariances that the moving ones have at
    every time.
    """
    moving = field.linear(scene.gaussians.select(scene.moving))
    tensors = scene.gaussians.tensors()
    for name, values in moving.gaussians.tensors().items():
        tensors[name] = tensors[name].index_copy(0, scene.moving, values)
    now = Gaussians(**tensors)
    times = torch.stack([moving.times, moving.log_stds], dim=1)
    lists.exact("lines", _numpy(torch.cat([moving.velocities, times], dim=1)[order]))
    header = {"moving": len(order), "least": MIN_WEIGHT, "waves": field.num_waves}
    header["exact"] = not field.depends_on_view
    if field.num_waves:
        lists.quantised("waves", _numpy(field.parameters["sh_time"][order].flatten(1)), 8)
    return header, now


def _add_curves(curves: MotionSplines, order: Tensor, lists: PackedArrays) -> dict[str, Any]:
    """Add splines of drivers, with Gaussians in ``order`` (M,)."""
    count, points, _ = curves.heads["means"].shape
    header: dict[str, Any] = {"count": count, "points": points, "moving": len(order)}
    header["error"] = curves.error
    has_nodes = curves.drivers is not None
    splines: dict[str, tuple[Tensor, int]] = {}
    for name, x in curves.heads.items():
        bits = 32 if curves.is_steep else 16 if has_nodes and name in FINE else 8
        splines[f"curve_{name}"] = (x if has_nodes else x[order], bits)
    pieces = points - SPAN + 1
    bits_of_piece = sum(len(x) * x.shape[2] * bits for x, bits in splines.values())
    chunk = max(CHUNK_BYTES * 8 // max(bits_of_piece, 1), 1)
    chunks = lists.chunks
    if chunks is None or chunk >= pieces:
        _add_splines(splines, slice(None), lists)
    else:
        for first in range(0, pieces, chunk):
            rows = torch.arange(first, first + chunk + SPAN - 1, device="cpu").clamp_max(points - 1)
            chunks.append(PackedArrays())
            _add_splines(splines, rows, chunks[-1])
        header |= {"chunk": chunk, "layout": chunks[0].layout}
    if curves.drivers is not None:
        pivots, followed, fractions = curves.drivers
        lists.exact("pivots", _numpy(pivots))
        lists.exact("followed", followed[order].numpy().astype(np.uint16))
        lists.exact("shares", _fractions(fractions[order]))
    if curves.windows is not None:
        lists.quantised("windows", _numpy(curves.windows[order]), 16)
        header |= {"edge": EDGE_WIDTH, "open": OPEN_WINDOW}
    return header


def _add_splines(
    splines: dict[str, tuple[Tensor, int]], rows: Tensor | slice, lists: PackedArrays
) -> None:
    """Add the control points ``rows`` of all splines."""
    for name, (points, bits) in splines.items():
        own = _numpy(points[:, rows].flatten(1))
        if bits == 32:
            lists.exact(name, own)
        else:
            lists.quantised(name, own, 16 if bits == 16 else 8)


def _add_person(
    scene: HumanScene, order: Tensor, lists: PackedArrays, tolerance: float
) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    clip = scene.played_clip
    skeleton = scene.learned_skeleton
    top = scene.weights[order].topk(min(BONES, scene.weights.shape[1]), dim=1)
    more = BONES - top.values.shape[1]
    boned, fractions = (torch.nn.functional.pad(x, (0, more)) for x in (top.indices, top.values))
    quats = Rotation.from_rotvec(_numpy(clip.poses).reshape(-1, 3)).as_quat(canonical=True)
    quats = np.roll(quats, 1, axis=1).astype(np.float32).reshape(len(clip), -1)
    lists.exact("boned", boned.numpy().astype(np.uint16))
    lists.exact("boned_shares", _fractions(fractions))
    lists.exact("joints", _numpy(skeleton.joints))
    lists.exact("clip_times", _numpy(clip.times[:, None]))
    lists.exact("clip_places", _numpy(torch.cat([clip.trans, clip.scale[:, None]], dim=1)))
    lists.quantised("clip_quats", quats, 16)
    header: dict[str, Any] = {"bones": {"parents": list(skeleton.parents)}}
    shapes = scene.shapes
    if shapes is not None:

        def offsets(time: float) -> Offsets:
            return Offsets(shapes.offsets(scene.anchors, clip.at(time).rotations[0]))

        heads, error = fit_splines(offsets, len(clip), tolerance)
        header["curves"] = _add_curves(MotionSplines(heads, error=error), order, lists)
    return header


def _add_network(network: ColourNetwork, lists: PackedArrays) -> dict[str, Any]:
    """Add the weights of a colour network, padded to multiples of four, each layer's biases after
    its weights."""
    widest = max(max(layer.weight.shape) for layer in network.layers)
    width = -(-widest // 4) * 4
    first = -(-network.layers[0].weight.shape[1] // 4) * 4
    parts: list[NDArray[np.float32]] = []
    for i, layer in enumerate(network.layers):
        weight = _numpy(layer.weight)
        rows = 3 if i == len(network.layers) - 1 else width
        columns = first if i == 0 else width
        missing = (0, rows - weight.shape[0]), (0, columns - weight.shape[1])
        bias = _numpy(layer.bias)
        longer = -(-rows // 4) * 4 - len(bias)
        parts += [np.pad(weight, missing).ravel(), np.pad(bias, (0, longer))]
    lists.exact("network", np.concatenate(parts).reshape(-1, 4))
    return {
        "network": {
            "layers": len(network.layers),
            "width": width,
            "first": first,
            "box": network.box.flatten().tolist(),
            "time": network.uses_time,
            "normals": network.uses_normals,
        }
    }


def _fractions(fractions: Tensor) -> NDArray[np.uint8]:
    """Return fractions in [0, 1] with 8 bits. The page normalises them."""
    return (255 * fractions).round().numpy().astype(np.uint8)


def _numpy(x: Tensor) -> NDArray[np.float32]:
    return x.detach().float().numpy()


SAMPLES_PER_PIECE = 3  # Samples of a motion per spline piece
FEWEST_PIECES, MOST_PIECES = 8, 256
# Smallest limit of pieces with few training times, between which a field may move freely
ALWAYS_ALLOWED = 32
CHECKED = 0.95  # Quantile of position errors (RMS over time) that must be within the tolerance


@dataclass(frozen=True)
class MotionSplines:
    """Uniform cubic B-splines of S drivers over the clip, and the Gaussians that follow them.

    Attributes:
        heads: control points (S, P, size) by attribute of ``Offsets``, always with "means".
        drivers: (S, 3) rotation centres of drivers, (M, B) drivers of each Gaussian, B = 4, and
            (M, B) their weights, which sum to 1. None if each Gaussian is its own driver.
        is_steep: control points lie far outside the visible range and are stored without
            quantisation.
        windows: (M, 2) start and end of each Gaussian's lifetime (``WindowedField``). None if all
            are permanent.
        error: quantile ``CHECKED`` of position errors of drivers, in world units.
    """

    heads: dict[str, Tensor]
    drivers: tuple[Tensor, Tensor, Tensor] | None = None
    is_steep: bool = False
    windows: Tensor | None = None
    error: float = 0.0


@torch.no_grad()
def motion_splines(
    field: DeformationField, means: Tensor, num_times: int, tolerance: float
) -> MotionSplines:
    """Return the motion of ``means`` (M, 3) as splines."""
    match field:
        case WindowedField(inner_field=inner):
            return replace(motion_splines(inner, means, num_times, tolerance), windows=field.edges)
        case ControlNodes():
            return _curves_of_nodes(field, means)
        case FreePrimitives():  # lines and parabolas
            return MotionSplines(_fit(lambda time: field.offsets(means, time), 1), is_steep=True)
        case _:
            heads, error = fit_splines(
                lambda time: field.offsets(means, time), num_times, tolerance
            )
            return MotionSplines(heads, error=error)


def fit_splines(
    offsets_at: Callable[[float], Offsets], num_times: int, tolerance: float
) -> tuple[dict[str, Tensor], float]:
    """Return control points (S, P, size) of splines fitted to offsets, by attribute, and their
    error.

    The number of pieces is doubled until the error is within ``tolerance``, or there are two pieces
    per training time.
    """
    pieces = FEWEST_PIECES
    most = min(max(2 * (num_times - 1), ALWAYS_ALLOWED), MOST_PIECES)
    while True:
        heads = _fit(offsets_at, pieces)
        error = _error(heads["means"], offsets_at, pieces)
        if error <= tolerance or pieces >= most:
            return heads, error
        pieces = min(2 * pieces, most)


def _fit(offsets_at: Callable[[float], Offsets], pieces: int) -> dict[str, Tensor]:
    count = SAMPLES_PER_PIECE * pieces + 1
    times = torch.linspace(0, 1, count, dtype=torch.float64, device="cpu")
    solver = torch.linalg.pinv(spline_basis(times, pieces)).float()  # (P, count)
    sums: dict[str, Tensor] = {}
    for time, fractions in zip(times.tolist(), solver.T, strict=True):
        for name, x in vars(offsets_at(time)).items():
            if x is not None:
                rows = x.reshape(len(x), 1, -1)
                sums.setdefault(name, rows.new_zeros(len(x), pieces + SPAN - 1, rows.shape[2]))
                sums[name] += fractions[:, None] * rows
    return sums


def _error(points: Tensor, offsets_at: Callable[[float], Offsets], pieces: int) -> float:
    """Return the quantile ``CHECKED`` of RMS position errors of the splines."""
    times = (torch.arange(pieces, dtype=torch.float64, device="cpu") + 0.5) / pieces
    apart = [
        (torch.einsum("p,spd->sd", fractions.float(), points) - offsets_at(time).means).norm(dim=1)
        for time, fractions in zip(times.tolist(), spline_basis(times, pieces), strict=True)
    ]
    errors = torch.stack(apart).square().mean(0).sqrt()
    return float(errors.sort().values[int(CHECKED * (len(errors) - 1))]) if len(errors) else 0.0


def _curves_of_nodes(field: ControlNodes, means: Tensor) -> MotionSplines:
    nodes = field.update_nodes(means)
    more = 0, FOLLOWED - nodes.followed.shape[1]  # of which a Gaussian follows nothing
    followed, fractions = (
        torch.nn.functional.pad(x, more) for x in (nodes.followed, nodes.weights(means))
    )
    heads = _fit(field.offsets_of_nodes, field.num_pieces)
    return MotionSplines(heads, (nodes.positions, followed, fractions))
