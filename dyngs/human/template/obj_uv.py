"""Reader of the texture coordinates of a body template from a Wavefront ``.obj`` file.

Local letters: M vertices, T triangles, U texture coordinates.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngs.errors import DyngsError, reason


@dataclass(frozen=True)
class TextureCoordinates:
    """Texture coordinates (U, 2) in [0, 1] and the triangles (T, 3) that index them."""

    uv: np.ndarray
    faces: np.ndarray


def require_unit_square(path: Path, uv: np.ndarray) -> np.ndarray:
    """Return texture coordinates (U, 2), rounding errors clipped; raises DyngsError where they leave [0, 1]."""
    outside = ~((uv > -1e-4) & (uv < 1 + 1e-4)).all(1)
    if outside.any():
        row = int(np.argmax(outside))
        raise DyngsError(
            f"{path}: texture coordinate {row} is {uv[row, 0]:g} {uv[row, 1]:g}; they must lie in [0, 1], on one tile"
        )
    return uv.clip(0, 1)


def read_obj(path: Path, faces: np.ndarray, num_vertices: int) -> TextureCoordinates:
    """Read the texture coordinates of an ``.obj``, indexed by the corners of the triangles ``faces`` (T, 3).

    Args:
        path: of the file; its triangles may come in any order, as ``f v/vt v/vt v/vt``.
        faces: (T, 3) vertices of the body's triangles.
        num_vertices: M of the body.

    Raises:
        DyngsError: the file cannot be read, or belongs to another body.
    """
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is not a file; name the .obj made for this body")
    try:
        lines = io.StringIO(path.read_text("latin-1"))
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({reason(error)})") from error
    count, uv, corners = 0, [], []
    for number, line in enumerate(lines, 1):
        if count > num_vertices or len(corners) > len(faces) or len(uv) > 3 * len(faces):
            break  # it belongs to another body, however long it is
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                count += 1
            elif kind == "vt":
                uv.append([float(words[0]), float(words[1])])
            elif kind == "f":
                one, two, three = words
                corners.append([_parsed_corner(word, count, len(uv)) for word in (one, two, three)])
        except (ValueError, IndexError):
            raise DyngsError(
                f"{path}, line {number}: {line.strip()[:60]!r} is not understood; texture coordinates are written "
                "'vt u v', triangles 'f v/vt v/vt v/vt'"
            ) from None
    if count != num_vertices or len(corners) != len(faces):
        raise DyngsError(
            f"{path}: has {count} vertices and {len(corners)} triangles, the body has {num_vertices} and {len(faces)}; "
            "give the .obj made for this body"
        )
    found = np.array(corners)
    if found.min() < 0 or (found.max((0, 1)) >= (count, len(uv))).any():
        raise DyngsError(f"{path}: a face names a vertex or texture coordinate that does not exist")
    return TextureCoordinates(
        require_unit_square(path, np.array(uv)), _matched(path, faces, found[..., 0], found[..., 1])
    )


def _parsed_corner(word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Return vertex and texture coordinate, from 0, of ``v/vt`` or ``v/vt/vn``; negative numbers count from the end."""
    vertex, coordinate = (int(number) for number in word.split("/")[:2])
    return (
        vertex - 1 if vertex > 0 else vertices + vertex,
        coordinate - 1 if coordinate > 0 else coordinates + coordinate,
    )


def _matched(path: Path, faces: np.ndarray, others: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``values`` (T, 3) of the corners of ``others``, reordered to the same triangles in ``faces``."""
    here, there = np.argsort(faces, axis=1, kind="stable"), np.argsort(others, axis=1, kind="stable")
    sorted_here, sorted_there = np.take_along_axis(faces, here, 1), np.take_along_axis(others, there, 1)
    rows, other_rows = np.lexsort(sorted_here.T), np.lexsort(sorted_there.T)
    differ = (sorted_here[rows] != sorted_there[other_rows]).any(1)
    if differ.any():
        odd = " ".join(str(v + 1) for v in others[other_rows[np.argmax(differ)]])
        raise DyngsError(f"{path}: the body has no triangle of the vertices {odd}; give the .obj made for this body")
    matched = np.empty_like(values)
    ordered = np.empty_like(values)
    ordered[rows] = np.take_along_axis(values, there, 1)[other_rows]
    np.put_along_axis(matched, here, ordered, 1)
    return matched
