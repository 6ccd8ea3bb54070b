"""A decoded image as it is kept in memory, of the CPU or of a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dyngs.ops.transfer import Upload


@dataclass(frozen=True)
class Decoded:
    """Pixels and maps of an image.

    Attributes:
        pixels: (H, W, 3 or 4) uint8, straight alpha.
        mask: (H, W) bool, or None.
        moves, depth, flow: maps as those of ``Image``, or None.
    """

    pixels: Tensor
    mask: Tensor | None
    moves: Tensor | None = None
    depth: Tensor | None = None
    flow: Tensor | None = None

    @property
    def num_bytes(self) -> int:
        return sum(x.nbytes for x in self._there().values())

    def upload(self, device: torch.device) -> Callable[[], Decoded]:
        """Begin to copy everything to ``device``; the result returns the image there."""
        arrays = self._there()
        upload = Upload(list(arrays.values()), device)
        nothing = {field.name: None for field in fields(self)}

        def uploaded() -> Decoded:
            return Decoded(**nothing | dict(zip(arrays, upload.arrays(), strict=True)))  # pyright: ignore[reportArgumentType]

        return uploaded

    def _there(self) -> dict[str, Tensor]:
        """Return the arrays that there are, by name."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: x for name, x in found.items() if x is not None}
