"""Limits of the size of a render: what the kernels can count, and what memory holds."""

from __future__ import annotations

from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.ops.native import core
from dyngs.ops.registration import shapes_only

MAX_SIDE: int = core.MAX_SIDE
"""px; float32 has no pixel centres beyond 2^23"""

UNASKED = 1 << 26
"""Bytes up to which the free memory is not asked for, because asking takes 0.1 ms."""

REMEDY = "lower the resolution, the scales or the number of views"


def check_size(width: int, height: int) -> None:
    """Raise an error unless images of this size can be drawn.

    Raises:
        DyngsError: a side below 1 or above ``MAX_SIDE``.
    """
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise DyngsError(f"render refused: an image of {width}x{height} px; its sides can be 1 to {MAX_SIDE} px")


def check_memory(size: int, what: str, like: Tensor) -> None:
    """Raise an error unless ``size`` bytes for ``what`` fit what machine, control groups and RLIMIT_AS leave free.

    Only where ``like`` lies on the CPU: in a GPU's memory torch itself refuses what does not fit.

    Raises:
        DyngsError: with both figures. (Where the system does not say, more than 16 GiB at once is refused.)
    """
    if shapes_only() or like.device.type != "cpu" or size <= UNASKED:
        return
    available = core.available_memory()
    if size > available:
        needed, left = (f"{x / 1e9:.1f} GB" for x in (size, available))
        raise DyngsError(f"render refused: {what} take {needed}; {left} of memory are available; {REMEDY}")
