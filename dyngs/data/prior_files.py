"""Files of priors that a capture names: depth maps, motion masks, optical flow, 2D tracks. None is ever required."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dyngs.data.capture import Splits, all_views
from dyngs.files.containment import inside

_KINDS = {"depth_path": "depth maps", "motion_mask_path": "motion masks", "flow_path": "flow fields"}


def present_priors(splits: Splits, tracks: Path | None) -> tuple[Splits, Path | None, list[str]]:
    """Return the splits and the tracks without priors whose files are missing, and a line for each kind of those.

    Raises:
        DyngsError: the tracks lie outside the capture.
    """
    notes = []
    for field, kind in _KINDS.items():
        paths = [path for view in all_views(splits) if (path := getattr(view, field)) is not None]
        missing = {path for path in paths if not path.is_file()}
        if not missing:
            continue
        notes.append(f"{len(missing)} of {len(paths)} {kind} are missing and do without, first {min(missing)}")
        splits = {
            name: tuple(replace(v, **{field: None}) if getattr(v, field) in missing else v for v in views)
            for name, views in splits.items()
        }
    if tracks is not None and not inside(tracks).is_file():
        return splits, None, [*notes, f"the tracks {tracks} are missing and are not used"]
    return splits, tracks, notes
