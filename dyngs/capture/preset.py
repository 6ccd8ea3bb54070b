"""Choice of a preset for a capture."""

from __future__ import annotations

from dyngs.capture.sfm.unposed import is_unposed, is_videos
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import all_views
from dyngs.data.read import PEOPLE_FILE, capture_folder, read_capture


def choose_preset(data: DataConfig) -> tuple[str, str]:
    """Return the preset that fits the capture, photos or video at ``data.root``, and the reason.

    Raises DyngsError: nothing to train on.
    """
    root = capture_folder(data.root)
    data = data.model_copy(update={"root": root})
    if (root / PEOPLE_FILE).is_file():
        raise DyngsError(f"{root}: holds captures of several people; choose a preset, such as gps")
    if is_unposed(data):
        if is_videos(root):
            return "dynamic", "video"
        return ("static", "photos") if data.times == "files" else ("dynamic", "photos in order")
    capture = read_capture(data, decode_videos=False)
    if capture.body is not None:
        return "human", "capture of a person"
    if any(view.time is not None for view in all_views(capture.splits)):
        return "dynamic", "capture with times"
    return "static", "capture without times"
