"""Reader for nerfstudio's and instant-ngp's ``transforms.json``."""

from __future__ import annotations

from pathlib import Path

from dyngs.data.capture import Capture, Split, Splits, View
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.point_files import find_points
from dyngs.data.readers.shared.transforms import FrameFile, read_frame_file, read_views, tracks_path_of
from dyngs.errors import DyngsError


def is_nerfstudio(root: Path) -> bool:
    """Whether the folder holds ``transforms.json``."""
    return (root / "transforms.json").is_file()


def read_nerfstudio(root: Path) -> Capture:
    """Read ``transforms.json`` with OpenGL camera-to-world poses and, if there, a ``.ply`` file of points.

    The lists ``train_filenames``, ``val_filenames`` and ``test_filenames`` decide the splits; a val list without a test
    list is used for testing. Points and poses are read as they stand: ``applied_transform``
    has been applied to both.

    Raises:
        DyngsError: see ``dyngs.data.readers.shared.transforms.read_views``; an unreadable ``.ply``.
    """
    file = read_frame_file(root / "transforms.json")
    views, warnings = read_views(file)
    splits, notes = _splits(file, views)
    found = find_points(file)
    return Capture(
        root,
        "nerfstudio",
        splits,
        found.points,
        fps=file.fps,
        points_file=found.path,
        tracks_path=tracks_path_of(file),
        warnings=(*warnings, *notes, *found.warnings),
    )


def _splits(file: FrameFile, views: dict[str, View]) -> tuple[Splits, list[str]]:
    """Splits by the lists in the file, all views for training where it has none; and warnings."""
    names: tuple[Split, ...] = ("train", "val", "test")
    listed = {name: file.fields.get(f"{name}_filenames") for name in names}
    if all(value is None for value in listed.values()):
        return {"train": tuple(views.values())}, []
    splits: Splits = {}
    unknown: list[str] = []
    for name in names:
        value = listed[name]
        if value is None:
            continue
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise DyngsError(f"{file.path}: '{name}_filenames' must be a list of file paths")
        splits[name] = tuple(views[item] for item in dict.fromkeys(value) if item in views)
        unknown += [item for item in value if item not in views]
    held_out = {view.name for kept in splits.values() for view in kept}
    splits.setdefault("train", tuple(view for view in views.values() if view.name not in held_out))
    if "test" not in splits and "val" in splits:
        splits["test"] = splits.pop("val")
    used = {view.name for kept in splits.values() for view in kept}
    notes = [f"{len(unknown)} listed images have no frame, first {unknown[0]}"] if unknown else []
    if len(used) < len(views):
        notes.append(f"{len(views) - len(used)} frames are in no split and are ignored")
    return splits, notes


FORMAT = CaptureFormat("nerfstudio", "transforms.json", is_nerfstudio, read_nerfstudio)
