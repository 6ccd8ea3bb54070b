"""Checks of masks: whether they ignore nearly everything, as masks do that are inverted or hold labels."""

from __future__ import annotations

from collections.abc import Sequence

from dyngs.data.capture import Capture, View, all_views
from dyngs.data.images.images import read_image, read_mask
from dyngs.data.times import evenly_spaced
from dyngs.errors import DyngsError

LOOKED_AT = 4
"""Masks that are read."""
MOST_IGNORED = 0.5
"""Fraction of the pixels that masks may ignore before that is suspicious: passers-by fill less."""


def mask_problems(capture: Capture) -> list[str]:
    """Return a line if masks ignore most of the pixels; a few masks are read, unreadable ones are passed over."""
    masked = [view for view in all_views(capture.splits) if view.mask_path is not None and view.mask_path.is_file()]
    looked_at = [masked[i] for i in evenly_spaced(len(masked), LOOKED_AT)]
    try:
        ignored = [1 - float(read_mask(view.mask_path).float().mean()) for view in looked_at if view.mask_path]
        if not ignored or sum(ignored) <= MOST_IGNORED * len(ignored):
            return []
        brightest = _brightest(looked_at)
    except DyngsError:  # told of by those who check files
        return []
    fraction, first = sum(ignored) / len(ignored), looked_at[0].mask_path
    why = (
        f"they hold no value above {brightest}, but white is 255: are they labels?"
        if brightest < 128
        else "white counts and black is ignored: are they inverted?"
    )
    return [f"masks ignore {fraction:.0%} of the pixels in {len(ignored)} that were looked at, first {first}; {why}"]


def _brightest(views: Sequence[View]) -> int:
    return max(int(read_image(view.mask_path)[..., :3].max()) for view in views if view.mask_path)
