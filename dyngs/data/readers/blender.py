"""Reader for Blender captures: NeRF-synthetic, and with ``time`` per frame D-NeRF."""

from __future__ import annotations

from pathlib import Path

from dyngs.data.capture import Capture, Split, Splits
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.transforms import read_frame_file, read_views, tracks_path_of


def is_blender(root: Path) -> bool:
    """Whether the folder holds ``transforms_train.json``."""
    return (root / "transforms_train.json").is_file()


def read_blender(root: Path) -> Capture:
    """Read ``transforms_{train,val,test}.json`` with OpenGL camera-to-world poses; val and test are optional.

    Intrinsics: ``camera_angle_x``, or ``w, h, fl_x, fl_y, cx, cy`` of the file or the frame.

    Raises:
        DyngsError: see ``dyngs.data.readers.shared.transforms.read_views``.
    """
    splits: Splits = {}
    warnings: list[str] = []
    fps = tracks = None
    names: tuple[Split, ...] = ("train", "val", "test")
    for name in names:
        path = root / f"transforms_{name}.json"
        if name != "train" and not path.is_file():
            continue
        file = read_frame_file(path)
        views, notes = read_views(file)
        if name == "train":
            fps, tracks = file.fps, tracks_path_of(file)
        splits[name] = tuple(views.values())
        warnings += [f"{path.name}: {note}" for note in notes]
        if not views:
            warnings.append(f"{path.name}: lists no frames")
    return Capture(root, "blender", splits, fps=fps, tracks_path=tracks, warnings=tuple(warnings))


FORMAT = CaptureFormat("blender", "transforms_train.json", is_blender, read_blender)
