"""What a browser picks, measures and deletes in a scene; files and runs on disk never change. Knows
no viser."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.api.edit import write_part
from dyngs.core.errors import DyngsError, counted
from dyngs.export.edit.crop import Box, held_by
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.similarity import UNMOVED, Similarity
from dyngs.runs.opened import Opened
from dyngs.view.cameras import camera_at
from dyngs.view.layers import Shot, depth_of

_SIZE = 9  # px, width and height of the image whose middle is picked
_SOLID = 0.5  # opacity below which a ray meets nothing


def looking_along(direction: np.ndarray) -> np.ndarray:
    """Return the quaternion wxyz, world from camera, of a camera that looks along ``direction``
    (3,)."""
    from scipy.spatial.transform import Rotation

    forward = direction / np.linalg.norm(direction)
    across = np.cross(np.eye(3)[int(np.abs(forward).argmin())], forward)
    across /= np.linalg.norm(across)
    matrix = np.stack([across, np.cross(forward, across), forward], axis=1)
    return Rotation.from_matrix(matrix).as_quat()[[3, 0, 1, 2]]


def world_of(opened: Opened) -> Similarity:
    """Return the way from a scene to the coordinates that `dyngs edit` means: of a file those of
    the file itself."""
    return UNMOVED if opened.captured is None else opened.world


def picked(
    opened: Opened,
    origin: np.ndarray,
    direction: np.ndarray,
    pixel: float,
    shot: Shot | None = None,
) -> np.ndarray | None:
    """Return the point (3,) of the scene that a ray meets, at the depth that is drawn there; None:
    it meets nothing.

    Depths are those of centres: the point is exact to about the size of the Gaussians there.

    ``origin``, ``direction``: (3,) of the ray. ``pixel``: rad that a pixel of the image sees.
    ``shot``: time and part that are shown.
    """
    numbers = np.array([*origin, *direction], np.float64)
    if not (np.isfinite(numbers).all() and np.linalg.norm(numbers[3:]) > 0 and pixel > 0):
        return None  # browsers may send anything
    camera = camera_at(
        looking_along(numbers[3:]), numbers[:3], 2 * math.atan(0.5 * _SIZE * pixel), (_SIZE, _SIZE)
    )
    time, part = (None, "all") if shot is None else (shot.time, shot.part)
    depth, alpha = (x[_SIZE // 2, _SIZE // 2] for x in depth_of(opened, part, camera, time))
    if not alpha >= _SOLID:
        return None
    return numbers[:3] + float(depth) * numbers[3:] / np.linalg.norm(numbers[3:])


@dataclass
class Editing:
    """Picked points, a box, and what is left of the scene ``whole`` after what was deleted.

    Attributes:
        points: at most two, (3,) each, in the coordinates of the scene.
        centre, size: (3,) each, of the box, in the coordinates that people mean (``world_of``).
        steps: (K,) indices into ``whole`` of the Gaussians that were left after each deletion.
    """

    whole: Opened
    centre: np.ndarray
    size: np.ndarray
    points: list[np.ndarray] = field(default_factory=list)
    steps: list[Tensor] = field(default_factory=list)

    @property
    def box(self) -> Box:
        return Box(self.centre - self.size / 2, self.centre + self.size / 2)

    @property
    def rows(self) -> Tensor:
        """(K,) indices of the Gaussians that are left."""
        return self.steps[-1] if self.steps else torch.arange(len(self.whole.scene), device="cpu")

    @property
    def left(self) -> Opened:
        """The scene that is left."""
        scene: GaussianScene = self.whole.scene
        return (
            self.whole.showing(scene.select(self.rows.to(scene.device)))
            if self.steps
            else self.whole
        )

    def pick(self, point: np.ndarray) -> None:
        """Add a picked point (3,); a third one is the first of a new pair."""
        self.points = [point] if len(self.points) == 2 else [*self.points, point]

    def delete(self, *, inside: bool) -> int:
        """Delete what the box holds, or all else; return how many Gaussians go. Raises DyngsError:
        all would."""
        scene: GaussianScene = self.left.scene
        kept = held_by(self.box, scene, world_of(self.whole)) ^ inside
        if not bool(kept.any()):
            raise DyngsError(
                "nothing would be left: the box holds "
                + ("all of the scene" if inside else "nothing")
            )
        gone = len(kept) - int(kept.sum())
        if gone:
            self.steps.append(self.rows[kept])
        return gone

    def undo(self) -> bool:
        """Take the last deletion back; return whether there was one."""
        return bool(self.steps) and self.steps.pop() is not None

    def file(self, time: float | None) -> bytes:
        """Return what is left as a .ply, at ``time`` if it moves."""
        with tempfile.TemporaryDirectory(prefix="dyngs_view_") as folder:
            moment = None if self.whole.scene.is_static else time
            return write_part(
                self.whole, self.rows, Path(folder) / "edited.ply", moment
            ).path.read_bytes()

    @property
    def said(self) -> str:
        """Lines of markdown about the picks, the box and what is left; options of `dyngs edit` that
        say the same."""
        world = world_of(self.whole)
        lines = list[str]()
        points = [world.points(point) for point in self.points]
        size = float(self.size.max())
        for name, point in zip("AB", points, strict=False):
            lines.append(f"{name}: `{_told(point, size)}`")
        if len(points) == 2:
            length = float(np.linalg.norm(points[1] - points[0]))
            lines.append(f"distance: **{length:.4g} {'m' if self.whole.scaled else 'units'}**")
            lines.append(f'`--scale "{_told(points[0], size)} {_told(points[1], size)} LENGTHm"`')
        lines.append(f"box: `--crop {_told(self.box.low, size)} {_told(self.box.high, size)}`")
        total = counted(len(self.whole.scene), "Gaussian")
        lines.append(f"{len(self.rows):,} of {total} left" if self.steps else total)
        return "\n\n".join(lines)


def _told(point: np.ndarray, size: float) -> str:
    """Return "x,y,z" with four digits, and as many more as a scene of ``size`` is far away from the
    origin."""
    digits = 4 + math.ceil(math.log10(max(float(np.abs(point).max()) / size, 1)))
    return ",".join(f"{x:.{digits}g}" for x in point)
