"""The numbers that a page draws: Gaussians, what moves them, what colours them, or triangles;
``data.js`` reads them. Motion is written as splines of a few drivers, which a program without dyngs
can play: a driver is a control node that several Gaussians follow, or the own one of each Gaussian
where a field has no nodes.

Local letters: N Gaussians, M of them moving, J joints, F frames of a clip; R rows and D columns of
a list; S drivers, P control points, B drivers that one Gaussian follows.
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
from dyngs.deform.scene import DynamicScene, field_scene_of
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import ColourNetwork
from dyngs.gaussians.levels import BLOCK, MAX_SPREAD_PX, MERGED, Block, Levels
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.posing import frame_pose, pose_blend_offsets
from dyngs.human.avatar.scene import HumanScene, as_human_scene
from dyngs.ops.nodes import SPAN

BONES = 8  # bones that a Gaussian follows on the page
FINE = ("means", "quats")  # splines of nodes that are stored in 16 bits
MAX_LOGIT = 15.0  # opacities beyond that of this logit are 1 to seven digits
CHUNK_BYTES = 1 << 19  # of splines that are fetched at once, before they are deflated
CHUNK = 256  # rows of a list that share a range for each column: neighbours in space are alike


class PackedArrays:
    """A block of bytes to which lists are added, and where they lie in it.

    ``layout``: by name what ``data.js`` needs to know. ``chunks``: splines that are fetched when
    they are played, all of one layout; None: everything is in the block.
    """

    def __init__(self, *, chunked: bool = False) -> None:
        self.chunks: list[PackedArrays] | None = [] if chunked else None
        self.layout: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def quantised(self, name: str, values: NDArray[np.float32], bits: Literal[8, 16]) -> None:
        """Add ``values`` (R, D) as 8 or 16 bits each: low + step * q, of each chunk and column.

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
        """Add ``values`` (R, D) as they are: uint8, uint16 or float32."""
        data = values.astype(values.dtype.newbyteorder("<")).tobytes()
        self._add(name, data, values.dtype.name, values.shape)

    def deflated(self) -> bytes:
        """Return the block as zlib writes it."""
        return zlib.compress(b"".join(self._parts), 9)

    def text(self) -> str:
        """Return the block, deflated, in base64."""
        return base64.b64encode(self.deflated()).decode("ascii")

    def _add(self, name: str, data: bytes, kind: str, shape: tuple[int, ...], **more: int) -> None:
        rows, columns = shape
        place = {"kind": kind, "rows": rows, "columns": columns, "at": self._size}
        self.layout[name] = place | more
        self._parts.append(data)
        self._size += len(data)


def add_scene(scene: GaussianScene, lists: PackedArrays, tolerance: float) -> dict[str, Any]:
    """Add the numbers of a scene to ``lists`` and return what the page needs to know about them.

    ``tolerance``: world units that a place may be off where motion is fitted.
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
    told: dict[str, Any] = {"count": len(scene), "frames": len(scene.times)}
    told["moves"] = not scene.is_static
    if person is not None:
        told |= _add_person(person, order, lists, tolerance)
    elif moved is not None:
        told |= _add_motion(moved, order, lists, tolerance)
    with_rest = scene.colour is None
    told |= _add_gaussians(gaussians.select(order).detach(), lists, with_rest=with_rest)
    return told if scene.colour is None else told | _add_network(scene.colour, lists)


def add_levels(levels: Levels, colour: ColourNetwork | None, lists: PackedArrays) -> dict[str, Any]:
    """Add where the blocks of ``levels`` are, and a colour network, and return what the page needs
    to know about all.

    The page fetches the blocks, see ``block_numbers``.
    """
    lists.exact("blocks", np.concatenate(levels.blocks).astype(np.float32))
    coarsest = block_numbers(levels, (len(levels.levels) - 1, 0), with_rest=colour is None)
    sizes = [len(level) for level in levels.levels]
    known = {"sizes": sizes, "block": BLOCK, "merged": MERGED, "pixels": MAX_SPREAD_PX}
    degree = levels.levels[0].sh_degree if colour is None else 0
    told: dict[str, Any] = {"count": sizes[0], "frames": 0, "moves": False, "degree": degree}
    told["levels"] = known | {"layout": coarsest.layout}
    return told if colour is None else told | _add_network(colour, lists)


def block_numbers(levels: Levels, block: Block, *, with_rest: bool) -> PackedArrays:
    """Return the lists of a block, ``BLOCK`` rows each; the last ones of a block that has fewer are
    never seen."""
    gaussians = levels.block_gaussians(block)
    rows = torch.arange(BLOCK, device="cpu").clamp_max(len(gaussians) - 1)
    padded = gaussians.select(rows)
    padded.logit_opacities[len(gaussians) :] = -MAX_LOGIT
    lists = PackedArrays()
    _add_gaussians(padded, lists, with_rest=with_rest)
    return lists


def block_files(levels: Levels, *, with_rest: bool) -> Iterator[tuple[str, bytes]]:
    """Yield names and bytes of the files of all blocks, as ``levels.js`` asks for them."""
    for level, balls in enumerate(levels.blocks):
        for place in range(len(balls)):
            numbers = block_numbers(levels, (level, place), with_rest=with_rest)
            yield f"{level}-{place}.bin", numbers.deflated()


def _add_gaussians(gaussians: Gaussians, lists: PackedArrays, *, with_rest: bool) -> dict[str, Any]:
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    logits = gaussians.logit_opacities.clamp(-MAX_LOGIT, MAX_LOGIT)
    lists.quantised("means", _numpy(gaussians.means), 16)
    lists.quantised("quats", _numpy(torch.where(unit[:, :1] < 0, -unit, unit)), 8)
    lists.quantised("log_scales", _numpy(gaussians.log_scales), 8)
    lists.quantised("logit_opacities", _numpy(logits[:, None]), 8)
    lists.quantised("base", _numpy(gaussians.sh[:, 0]), 8)
    degree = gaussians.sh_degree if with_rest else 0
    if degree:
        lists.quantised("rest", _numpy(gaussians.sh[:, 1:].flatten(1)), 8)
    return {"degree": degree}


def _add_motion(
    scene: DynamicScene, order: Tensor, lists: PackedArrays, tolerance: float
) -> dict[str, Any]:
    """Add the motion of a scene whose Gaussians are stored in ``order``, moving ones first."""
    if scene.field is None:
        return {}
    place = torch.full((len(scene),), -1, device="cpu")
    place[scene.moving] = torch.arange(len(scene.moving), device="cpu")
    mine = place[order[: len(scene.moving)]]
    curves = motion_splines(
        scene.field, scene.gaussians.means[scene.moving], len(scene.times), tolerance
    )
    told: dict[str, Any] = {"curves": _add_curves(curves, mine, lists)}
    if scene.filter_std is not None:
        lists.quantised("filter_std", _numpy(scene.filter_std[order][:, None]), 8)
        told["filtered"] = True
    if scene.masks is not None:
        masks = scene.masks.select(order)
        lists.exact("masks", masks.bits.numpy())
        told["masks"] = {"times": list(masks.times)}
    return told


def _add_curves(curves: MotionSplines, order: Tensor, lists: PackedArrays) -> dict[str, Any]:
    """Add splines of drivers, with the Gaussians that follow them, or their own ones, in ``order``
    (M,)."""
    count, points, _ = curves.heads["means"].shape
    told: dict[str, Any] = {"count": count, "points": points, "moving": len(order)}
    told["error"] = curves.error
    has_nodes = curves.pivots is not None  # few, each of which moves many
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
        told |= {"chunk": chunk, "layout": chunks[0].layout}
    if curves.pivots is not None and curves.followed is not None and curves.fractions is not None:
        lists.exact("pivots", _numpy(curves.pivots))
        lists.exact("followed", curves.followed[order].numpy().astype(np.uint16))
        lists.exact("shares", _fractions(curves.fractions[order]))
    if curves.windows is not None:
        lists.quantised("windows", _numpy(curves.windows[order]), 16)
        told |= {"edge": EDGE_WIDTH, "open": OPEN_WINDOW}
    return told


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
    told: dict[str, Any] = {"bones": {"parents": list(skeleton.parents)}}
    if scene.shapes is not None:

        def offsets(time: float) -> Offsets:
            found = pose_blend_offsets(scene.anchors, frame_pose(clip.at(time), 0), scene.shapes)
            return Offsets(torch.zeros_like(scene.gaussians.means) if found is None else found)

        heads, error = fit_splines(offsets, len(clip), tolerance)
        told["curves"] = _add_curves(MotionSplines(heads, error=error), order, lists)
    return told


def _add_network(network: ColourNetwork, lists: PackedArrays) -> dict[str, Any]:
    """Add the rows of all layers, padded to four columns, each layer's biases after its weights."""
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
    """Return shares in [0, 1] as 8 bits; the page makes their sums 1 again."""
    return (255 * fractions).round().numpy().astype(np.uint8)


def _numpy(x: Tensor) -> NDArray[np.float32]:
    return x.detach().float().numpy()


SAMPLES_PER_PIECE = 3  # Times per piece at which a motion is looked at
FEWEST_PIECES, MOST_PIECES = 8, 256
# Pieces, however few training times there are: between those a network moves as it likes
ALWAYS_ALLOWED = 32
# Quantile of the places' errors, root mean squares over time, that a fit keeps within its tolerance
CHECKED = 0.95


@dataclass(frozen=True)
class MotionSplines:
    """Offsets of S drivers, uniform cubic B-splines over the clip, and who follows them.

    Attributes:
        heads: control points (S, P, size) by attribute of ``Offsets``; always "means".
        pivots: (S, 3) places that drivers turn about; None: S = M, and each Gaussian has its own,
            about itself.
        followed: (M, B) drivers of each Gaussian, B = 4; None as above.
        fractions: (M, B) of theirs, rows sum to 1; None as above.
        is_steep: control points lie far outside what is drawn, and are to be kept as they are.
        windows: (M, 2) begin and end of each Gaussian's window in time (``WindowedField``); None:
            all are always there.
        error: of a driver's place: the quantile ``CHECKED``, in world units.
    """

    heads: dict[str, Tensor]
    pivots: Tensor | None = None
    followed: Tensor | None = None
    fractions: Tensor | None = None
    is_steep: bool = False
    windows: Tensor | None = None
    error: float = 0.0


@torch.no_grad()
def motion_splines(
    field: DeformationField, means: Tensor, num_times: int, tolerance: float
) -> MotionSplines:
    """Return the motion of ``means`` (M, 3) as splines."""
    match field:
        case WindowedField(others=others):
            return replace(motion_splines(others, means, num_times, tolerance), windows=field.edges)
        case ControlNodes():
            return _curves_of_nodes(field, means)
        case FreePrimitives():  # straight lines and parabolas
            return MotionSplines(_fit(lambda time: field.offsets(means, time), 1), is_steep=True)
        case _:
            heads, error = fit_splines(
                lambda time: field.offsets(means, time), num_times, tolerance
            )
            return MotionSplines(heads, error=error)


def fit_splines(
    offsets_at: Callable[[float], Offsets], num_times: int, tolerance: float
) -> tuple[dict[str, Tensor], float]:
    """Return control points (S, P, size), by attribute, of the splines nearest to offsets, and the
    error of places.

    The number of pieces is doubled until the error is within ``tolerance``, or there are two for
    each training time.
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
    """Return the quantile ``CHECKED`` of the splines' distances from the places, root mean squares
    over the pieces."""
    times = (torch.arange(pieces, dtype=torch.float64, device="cpu") + 0.5) / pieces
    apart = [
        (torch.einsum("p,spd->sd", fractions.float(), points) - offsets_at(time).means).norm(dim=1)
        for time, fractions in zip(times.tolist(), spline_basis(times, pieces), strict=True)
    ]
    found = torch.stack(apart).square().mean(0).sqrt()
    return float(found.sort().values[int(CHECKED * (len(found) - 1))]) if len(found) else 0.0


def _curves_of_nodes(field: ControlNodes, means: Tensor) -> MotionSplines:
    nodes = field.nodes_for(means)
    more = 0, FOLLOWED - nodes.followed.shape[1]  # of which a Gaussian follows nothing
    followed, fractions = (
        torch.nn.functional.pad(x, more) for x in (nodes.followed, nodes.weights(means))
    )
    return MotionSplines(_fit(field.at, field.num_pieces), nodes.positions, followed, fractions)
