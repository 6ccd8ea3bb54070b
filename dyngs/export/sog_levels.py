"""PlayCanvas' streamed ``.sog``: a folder of a still scene in levels of detail, of which viewers
fetch what they see.

``lod-meta.json`` (version 1) holds a tree of boxes; its leaves name, for each level, a file and a
range of Gaussians in it. Files are ``.sog`` as folders: ``LEVEL_NUMBER/meta.json`` and images. The
order of ``dyngs.gaussians.levels`` makes what a leaf shows consecutive at each level. Format:
PlayCanvas, "The Streamed SOG Format", 2026.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.core.gaussians import Gaussians
from dyngs.gaussians.levels import MERGED, Levels, levels_of
from dyngs.io.formats.formats import SOG_INDEX
from dyngs.io.formats.sog import sog_parts
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.outputs import new_folder, require_new_folder
from dyngs.ops.quaternions import rotation_matrices

PER_LEAF = MERGED**7  # Gaussians of a leaf at level 0
PER_FILE = MERGED**9  # at most, at each level
COARSEST = 4  # Level, at most; 64 Gaussians of a leaf
_REACH = 3.0  # standard deviations of a Gaussian that its box holds


def write_sog_levels(folder: Path, splat: SplatFile) -> tuple[int, ...]:
    """Write a new folder of what ``fitted`` made fit a .sog, and return the Gaussians by level, the
    finest first.

    Raises DyngsError: the folder holds something, or cannot be written.
    """
    require_new_folder(folder)
    tree = levels_of(splat.gaussians)
    levels = tree.levels[: COARSEST + 1]
    counts = tuple(len(level) for level in levels)
    names: list[str] = []
    with new_folder(folder) as started:
        first = []  # number of a level's first file
        for number, level in enumerate(levels):
            first.append(len(names))
            for i, start in enumerate(range(0, len(level), PER_FILE)):
                part = level.select(
                    torch.arange(start, min(start + PER_FILE, len(level)), device="cpu")
                )
                names.append(f"{number}_{i}/meta.json")
                (started / f"{number}_{i}").mkdir()
                for name, data in sog_parts(replace(splat, gaussians=part)):
                    (started / f"{number}_{i}" / name).write_bytes(data)
        index = {
            "version": 1,
            "asset": {"generator": "dyngs"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "filenames": names,
            "tree": _joined(list(_leaves(tree, counts, first))),
        }
        (started / SOG_INDEX).write_text(json.dumps(index, separators=(",", ":")), encoding="utf-8")
    return counts


def _leaves(tree: Levels, counts: tuple[int, ...], first: list[int]) -> Iterator[dict[str, Any]]:
    """Yield the leaves in the order of the tree."""
    for start in range(0, counts[0], PER_LEAF):
        lods = {}
        for level, count in enumerate(counts):
            own = start // MERGED**level
            size = PER_LEAF // MERGED**level
            where = {
                "file": first[level] + own // PER_FILE,
                "offset": own % PER_FILE,
                "count": min(size, count - own),
            }
            lods[str(level)] = where
        rows = torch.arange(start, min(start + PER_LEAF, counts[0]), device="cpu")
        yield {"bound": _box(tree.levels[0].select(rows)), "lods": lods}


def _box(gaussians: Gaussians) -> dict[str, list[float]]:
    """Return the box around Gaussians, to three standard deviations."""
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None]
    reach = _REACH * axes.square().sum(2).sqrt()
    low = (gaussians.means - reach).amin(0)
    high = (gaussians.means + reach).amax(0)
    return {"min": low.tolist(), "max": high.tolist()}


def _joined(nodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the root above nodes that follow each other, four below each."""
    while len(nodes) > 1:
        groups = [nodes[i : i + MERGED] for i in range(0, len(nodes), MERGED)]
        nodes = [
            {"bound": _around([node["bound"] for node in group]), "children": group}
            for group in groups
        ]
    return nodes[0]


def _around(boxes: list[dict[str, list[float]]]) -> dict[str, list[float]]:
    low = np.min([box["min"] for box in boxes], axis=0)
    high = np.max([box["max"] for box in boxes], axis=0)
    return {"min": low.tolist(), "max": high.tolist()}
