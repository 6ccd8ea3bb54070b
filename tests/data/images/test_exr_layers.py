"""Names of layers as renderers write them, and which of them is the image."""

from __future__ import annotations

import pytest

from dyngs.data.images.images import find_beauty_pass, list_layers


def channels(layer: str, names: str = "RGBA") -> list[str]:
    return [f"{layer}.{name}" if layer else name for name in names]


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        (
            [("", channels("N") + channels("ViewLayer.Combined") + ["ViewLayer.Depth.Z"])],
            "ViewLayer.Combined",
        ),
        ([("", channels("albedo") + channels("") + ["Z"])], ""),
        ([("", channels("diffuse", "RGB") + channels("BEAUTY", "rgb"))], "BEAUTY"),
        ([("N", channels("", "RGB")), ("C", channels(""))], "C"),
        ([("first", channels("depth", "Z")), ("second", channels("beauty"))], "beauty"),
        ([("", ["n.red", "n.green", "n.blue", "rgba.red", "rgba.green", "rgba.blue"])], "rgba"),
        (
            [("", channels("RenderLayer.Combined") + channels("Composite.Combined"))],
            "Composite.Combined",
        ),
        ([("", channels("beauty", "Y") + channels("N", "RGB"))], "beauty"),
    ],
)
def test_the_image_itself(parts: list[tuple[str, list[str]]], name: str) -> None:
    layer = find_beauty_pass(list_layers(parts))
    assert layer is not None
    assert layer.name == name
    names = parts[layer.part][1]
    assert [names[index].rpartition(".")[2][0].upper() for index in layer.colours] in (
        ["R", "G", "B"],
        ["Y"],
    )
