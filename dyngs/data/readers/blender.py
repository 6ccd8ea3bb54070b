"""Reader for Blender captures: NeRF-synthetic, and with ``time`` per frame D-NeRF."""

from __future__ import annotations

from pathlib import Path

from dyngs.data.capture import Capture, Split, Splits
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.point_files import FoundPoints, find_points
from dyngs.data.readers.shared.transforms import read_frame_file, read_views, tracks_path_of


def is_blender(root: Path) -> bool:
    """Whether the folder holds ``transforms_train.json``."""
    return (root / "transforms_train.json").is_file()


def read_blender(root: Path) -> Capture:
    """Read ``transforms_{train,val,test}.json`` with OpenGL camera-to-world poses; val and test are optional.

    Intrinsics: ``camera_angle_x``, or ``w, h, fl_x, fl_y, cx, cy`` of the file or the frame.
    Points: see ``find_points``.

    Raises:
        DyngsError: see ``dyngs.data.readers.shared.transforms.read_views``.
    """
    splits: Splits = {}
    warnings: list[str] = []
    fps, found, tracks = None, FoundPoints(), None
    names: tuple[Split, ...] = ("train", "val", "test")
    for name in names:
        path = root / f"transforms_{name}.json"
        if name != "train" and not path.is_file():
            continue
        file = read_frame_file(path)
        views, notes = read_views(file)
        if name == "train":
            fps, found, tracks = file.fps, find_points(file), tracks_path_of(file)
        splits[name] = tuple(views.values())
        warnings += [f"{path.name}: {note}" for note in notes]
        if not views:
            warnings.append(f"{path.name}: lists no frames")
    warnings += found.warnings
    place, lines = found.path, tuple(warnings)
    return Capture(
        root, "blender", splits, found.points, fps=fps, points_file=place, tracks_path=tracks, warnings=lines
    )


FORMAT = CaptureFormat("blender", "transforms_train.json", is_blender, read_blender)
