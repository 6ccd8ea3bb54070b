"""Choice of the beauty pass of an OpenEXR file, by the names of its parts and layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

BEAUTY_NAMES = (
    "", "rgba", "rgb", "combined", "c", "ci", "beauty", "main", "image", "final", "color", "colour",
    "composite",
)  # fmt: skip
"""Last words of a layer's name that mean the beauty pass, best first; "": channels without a
layer."""
_SHORT = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}


@dataclass(frozen=True)
class Layer:
    """Channels of one layer: their index by name, in lower case, in the part with this number."""

    name: str
    part: int
    channels: dict[str, int]

    @property
    def colours(self) -> tuple[int, ...]:
        """Indices of red, green and blue, or of luminance (Y without X); empty without them."""
        names = "y" if "y" in self.channels and "x" not in self.channels else "rgb"
        found = tuple(self.channels[name] for name in names if name in self.channels)
        return found if len(found) == len(names) else ()

    @property
    def label(self) -> str:
        return f"{self.name or 'without a name'} ({', '.join(self.channels)})"


def layers_of(parts: Sequence[tuple[str, Sequence[str]]]) -> list[Layer]:
    """Return the layers of a file by its parts, (name, names of channels such as ``layer.R``)."""
    layers: dict[tuple[int, str], Layer] = {}
    for number, (part, names) in enumerate(parts):
        for index, name in enumerate(names):
            prefix, _, channel = name.rpartition(".")
            layer = prefix or (part if len(parts) > 1 else "")
            found = layers.setdefault((number, layer), Layer(layer, number, {}))
            found.channels[_SHORT.get(channel.lower(), channel.lower())] = index
    return list(layers.values())


def beauty_pass(layers: Sequence[Layer]) -> Layer | None:
    """Return the beauty pass; None if no layer has such a name, or several have.

    Blender's compositor writes ``Composite.Combined`` beside the ``Combined`` of each view layer.
    """
    ranked: dict[tuple[int, bool], list[Layer]] = {}
    for layer in layers:
        first, _, last = layer.name.lower().rpartition(".")
        if layer.colours and last in BEAUTY_NAMES:
            ranked.setdefault((BEAUTY_NAMES.index(last), first != "composite"), []).append(layer)
    best = ranked[min(ranked)] if ranked else []
    return best[0] if len(best) == 1 else None
