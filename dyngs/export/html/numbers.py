"""The numbers that a page draws: Gaussians, what moves them, what colours them, or triangles;
``data.js`` reads them.

Local letters: N Gaussians, M of them moving, J joints, F frames of a clip; R rows and D columns of
a list.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyngs.baselines.triangles.patches import CORNERS
from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.gaussians import storage_order
from dyngs.deform.field import Offsets
from dyngs.deform.fields import EDGE, OPEN
from dyngs.deform.scene import DynamicScene, field_scene_of
from dyngs.export.html.curves import Curves, curves_of, fitted_curves
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import ColourNetwork
from dyngs.gaussians.levels import BLOCK, MERGED, PIXELS, Block, Levels
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.posing import frame_pose, rest_offsets
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.ops.nodes import SPAN

BONES = 8  # bones that a Gaussian follows on the page
FINE = ("means", "quats")  # splines of nodes that are stored in 16 bits
MOST_LOGIT = 15.0  # opacities beyond that of this logit are 1 to seven digits
CHUNK_BYTES = 1 << 19  # of splines that are fetched at once, before they are deflated
CHUNK = 256  # rows of a list that share a range for each column: neighbours in space are alike


class Lists:
    """A block of bytes to which lists are added, and where they lie in it.

    ``layout``: by name what ``data.js`` needs to know. ``chunks``: splines that are fetched when
    they are played, all of one layout; None: everything is in the block.
    """

    def __init__(self, *, chunked: bool = False) -> None:
        self.chunks: list[Lists] | None = [] if chunked else None
        self.layout: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def quantised(self, name: str, values: NDArray[np.float32], bits: Literal[8, 16]) -> None:
        """Add ``values`` (R, D) as 8 or 16 bits each: low + step * q, of each chunk and column.

        The error is at most half a step: the range of the chunk over 510 or 131,070.
        """
        rows, columns = values.shape
        count = -(-rows // CHUNK)
        ranges = np.zeros((count, columns, 2), dtype="<f4")
        quantised = np.zeros((rows, columns), dtype=np.uint16)
        for i in range(count):
            part = slice(i * CHUNK, (i + 1) * CHUNK)
            low = values[part].min(0)
            high = values[part].max(0)
            step = ((high.astype(np.float64) - low) / (2**bits - 1)).astype(np.float32)
            ranges[i] = np.stack([low, step], axis=1)
            relative = (values[part].astype(np.float64) - low) / np.where(step > 0, step, 1)
            quantised[part] = relative.round().clip(0, 2**bits - 1)
        planes = [quantised >> 8, quantised & 255] if bits == 16 else [quantised]
        # (D, planes, R)
        bytes_of = np.stack([plane.T.astype(np.uint8) for plane in planes], axis=1)
        self._add(
            name,
            ranges.tobytes() + bytes_of.tobytes(),
            "quantised",
            values.shape,
            bits=bits,
            chunk=CHUNK,
        )

    def exact(self, name: str, values: NDArray[Any]) -> None:
        """Add ``values`` (R, D) as they are: uint8, uint16 or float32."""
        kind = values.dtype.name
        if kind not in ("uint8", "uint16", "float32"):
            raise ValueError(f"{name}: a list of {kind} cannot be added")
        self._add(name, values.astype(values.dtype.newbyteorder("<")).tobytes(), kind, values.shape)

    @property
    def size(self) -> int:
        """Number of bytes before they are deflated."""
        return self._size

    def deflated(self) -> bytes:
        """Return the block as zlib writes it."""
        return zlib.compress(b"".join(self._parts), 9)

    def text(self) -> str:
        """Return the block, deflated, in base64."""
        return base64.b64encode(self.deflated()).decode("ascii")

    def _add(self, name: str, data: bytes, kind: str, shape: tuple[int, ...], **more: int) -> None:
        rows, columns = shape
        self.layout[name] = {
            "kind": kind,
            "rows": rows,
            "columns": columns,
            "at": self._size,
            **more,
        }
        self._parts.append(data)
        self._size += len(data)


def add_scene(scene: GaussianScene, lists: Lists, tolerance: float) -> dict[str, Any]:
    """Add the numbers of a scene to ``lists`` and return what the page needs to know about them.

    ``tolerance``: world units that a place may be off where motion is fitted.
    """
    person = avatar_of(scene)
    moved = field_scene_of(scene)
    if person is not None:
        order = torch.from_numpy(
            storage_order(_numpy(scene.gaussians.means), np.arange(len(scene)))
        )
        gaussians = scene.gaussians.select(order)
        told = _add_person(person, order, lists, tolerance)
    elif moved is not None:
        order = torch.from_numpy(storage_order(_numpy(scene.gaussians.means), moved.moving.numpy()))
        gaussians = scene.gaussians.select(order)
        told = _add_motion(moved, order, lists, tolerance)
    else:
        still = scene.at(None)
        order = torch.from_numpy(storage_order(_numpy(still.means), np.zeros(0, dtype=np.int64)))
        gaussians = still.select(order)
        told = {}
    told |= _add_gaussians(gaussians.detach(), lists, with_rest=scene.colour is None)
    if scene.colour is not None:
        told["network"] = _add_network(scene.colour, lists)
    return told | {"count": len(scene), "frames": len(scene.times), "moves": not scene.is_static}


def add_levels(levels: Levels, colour: ColourNetwork | None, lists: Lists) -> dict[str, Any]:
    """Add where the blocks of ``levels`` are, and a colour network, and return what the page needs
    to know about all.

    The page fetches the blocks, see ``block_numbers``.
    """
    told: dict[str, Any] = {} if colour is None else {"network": _add_network(colour, lists)}
    lists.exact("blocks", np.concatenate(levels.blocks).astype(np.float32))
    coarsest = block_numbers(levels, (len(levels.levels) - 1, 0), with_rest=colour is None)
    sizes = [len(level) for level in levels.levels]
    known = {
        "sizes": sizes,
        "block": BLOCK,
        "merged": MERGED,
        "pixels": PIXELS,
        "layout": coarsest.layout,
    }
    degree = levels.levels[0].sh_degree if colour is None else 0
    return told | {
        "levels": known,
        "degree": degree,
        "count": sizes[0],
        "frames": 0,
        "moves": False,
    }


def block_numbers(levels: Levels, block: Block, *, with_rest: bool) -> Lists:
    """Return the lists of a block, ``BLOCK`` rows each; the last ones of a block that has fewer are
    never seen."""
    gaussians = levels.of_block(block)
    rows = torch.arange(BLOCK, device="cpu").clamp_max(len(gaussians) - 1)
    padded = gaussians.select(rows)
    padded.logit_opacities[len(gaussians) :] = -MOST_LOGIT
    lists = Lists()
    _add_gaussians(padded, lists, with_rest=with_rest)
    return lists


def block_files(levels: Levels, *, with_rest: bool) -> Iterator[tuple[str, bytes]]:
    """Yield names and bytes of the files of all blocks, as ``levels.js`` asks for them."""
    for level, balls in enumerate(levels.blocks):
        for place in range(len(balls)):
            yield (
                f"{level}-{place}.bin",
                block_numbers(levels, (level, place), with_rest=with_rest).deflated(),
            )


def add_triangles(scene: TriangleScene, lists: Lists) -> dict[str, Any]:
    """Add the numbers of curved triangles to ``lists`` and return what the page needs to know about
    them."""
    patches = scene.patches
    middles = _numpy(patches.points[:, CORNERS].mean(1))
    order = torch.from_numpy(storage_order(middles, np.zeros(0, dtype=np.int64)))
    lists.quantised("points", _numpy(patches.points[order].flatten(1)), 16)
    lists.quantised("colours", _numpy(patches.colours[order].flatten(1)), 8)
    if patches.sh_degree:
        lists.quantised("rest", _numpy(patches.harmonics[order].flatten(1)), 8)
    told = {
        "degree": patches.sh_degree,
        "texture": patches.texture,
        "segments": scene.options.segments,
    }
    return told | {
        "bounds": scene.bounds.tolist(),
        "count": len(scene),
        "frames": 0,
        "moves": False,
    }


def _add_gaussians(gaussians: Gaussians, lists: Lists, *, with_rest: bool) -> dict[str, Any]:
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    unit = torch.where(unit[:, :1] < 0, -unit, unit)
    lists.quantised("means", _numpy(gaussians.means), 16)
    lists.quantised("quats", _numpy(unit), 8)
    lists.quantised("log_scales", _numpy(gaussians.log_scales), 8)
    lists.quantised(
        "logit_opacities",
        _numpy(gaussians.logit_opacities.clamp(-MOST_LOGIT, MOST_LOGIT)[:, None]),
        8,
    )
    lists.quantised("base", _numpy(gaussians.sh[:, 0]), 8)
    degree = gaussians.sh_degree if with_rest else 0
    if degree:
        lists.quantised("rest", _numpy(gaussians.sh[:, 1:].flatten(1)), 8)
    return {"degree": degree}


def _add_motion(
    scene: DynamicScene, order: Tensor, lists: Lists, tolerance: float
) -> dict[str, Any]:
    """Add the motion of a scene whose Gaussians are stored in ``order``, moving ones first."""
    if scene.field is None:
        return {}
    place = torch.full((len(scene),), -1, device="cpu")
    place[scene.moving] = torch.arange(len(scene.moving), device="cpu")
    mine = place[order[: len(scene.moving)]]
    curves = curves_of(
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


def _add_curves(curves: Curves, order: Tensor, lists: Lists) -> dict[str, Any]:
    """Add splines of drivers, with the Gaussians that follow them, or their own ones, in ``order``
    (M,)."""
    count, points, _ = curves.heads["means"].shape
    told: dict[str, Any] = {
        "count": count,
        "points": points,
        "moving": len(order),
        "error": curves.error,
    }
    pieces = points - SPAN + 1
    chunk = _pieces_of_chunk(curves)
    chunks = lists.chunks
    if chunks is None or chunk >= pieces:
        _add_splines(curves, slice(None), order, lists)
    else:
        for first in range(0, pieces, chunk):
            rows = torch.arange(first, first + chunk + SPAN - 1, device="cpu").clamp_max(points - 1)
            chunks.append(Lists())
            _add_splines(curves, rows, order, chunks[-1])
        told |= {"chunk": chunk, "layout": chunks[0].layout}
    if curves.pivots is not None and curves.followed is not None and curves.fractions is not None:
        lists.exact("pivots", _numpy(curves.pivots))
        lists.exact("followed", curves.followed[order].numpy().astype(np.uint16))
        lists.exact("shares", _fractions(curves.fractions[order]))
    if curves.windows is not None:
        lists.quantised("windows", _numpy(curves.windows[order]), 16)
        told |= {"edge": EDGE, "open": OPEN}
    return told


def _add_splines(curves: Curves, rows: Tensor | slice, order: Tensor, lists: Lists) -> None:
    """Add the control points ``rows`` of all splines."""
    has_nodes = curves.pivots is not None  # few, each of which moves many
    for name, points in curves.heads.items():
        own = _numpy((points if has_nodes else points[order])[:, rows].flatten(1))
        if curves.is_steep:
            lists.exact(f"curve_{name}", own)
        else:
            lists.quantised(f"curve_{name}", own, _bits(curves, name))


def _bits(curves: Curves, name: str) -> Literal[8, 16]:
    return 16 if curves.pivots is not None and name in FINE else 8


def _pieces_of_chunk(curves: Curves) -> int:
    """Return the pieces of a chunk of time of some ``CHUNK_BYTES``."""
    wide = 32 if curves.is_steep else 0
    sizes = (
        x.shape[0] * x.shape[2] * (wide or _bits(curves, name)) for name, x in curves.heads.items()
    )
    return max(CHUNK_BYTES * 8 // max(sum(sizes), 1), 1)


def _add_person(scene: HumanScene, order: Tensor, lists: Lists, tolerance: float) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    clip = scene.moves_as
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
            found = rest_offsets(scene.anchors, frame_pose(clip.at(time), 0), scene.shapes)
            return Offsets(torch.zeros_like(scene.gaussians.means) if found is None else found)

        heads, error = fitted_curves(offsets, len(clip), tolerance)
        told["curves"] = _add_curves(Curves(heads, error=error), order, lists)
    return told


def _add_network(network: ColourNetwork, lists: Lists) -> dict[str, Any]:
    """Add the rows of all layers, padded to four columns, each layer's biases after its weights."""
    widest = max(max(layer.weight.shape) for layer in network.layers)
    width = -(-widest // 4) * 4
    first = -(-network.layers[0].weight.shape[1] // 4) * 4
    parts: list[NDArray[np.float32]] = []
    for i, layer in enumerate(network.layers):
        rows = 3 if i == len(network.layers) - 1 else width
        weight = np.zeros((rows, first if i == 0 else width), dtype=np.float32)
        weight[: layer.weight.shape[0], : layer.weight.shape[1]] = _numpy(layer.weight.detach())
        bias = np.zeros(-(-rows // 4) * 4, dtype=np.float32)
        bias[: len(layer.bias)] = _numpy(layer.bias.detach())
        parts += [weight.ravel(), bias]
    lists.exact("network", np.concatenate(parts).reshape(-1, 4))
    told = {
        "layers": len(network.layers),
        "width": width,
        "first": first,
        "box": network.box.flatten().tolist(),
    }
    return told | {"time": network.sees_time, "normals": network.sees_normals}


def _fractions(fractions: Tensor) -> NDArray[np.uint8]:
    """Return shares in [0, 1] as 8 bits; the page makes their sums 1 again."""
    return (255 * fractions).round().numpy().astype(np.uint8)


def _numpy(x: Tensor) -> NDArray[np.float32]:
    return x.detach().float().numpy()
