"""The same drawing as text and as pixels."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from dyngs.tradeoff.vector_graphics import Circle, Drawing, Line, Text

SHAPES = (
    Line(((10, 10), (90, 10)), "#ff0000", 2),
    Circle(30, 30, 6, "#0000ff", "a <tip> & more"),
    Text(60, 40, "dB < 3 & more", "middle", bold=True),
)


def test_svg_is_well_formed_and_fetches_nothing() -> None:
    text = Drawing(100, 50, SHAPES).svg()
    root = ElementTree.fromstring(text)
    assert (root.attrib["width"], root.attrib["height"]) == ("100", "50")
    assert {"a <tip> & more", "dB < 3 & more"} <= {element.text for element in root.iter()}
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")


def test_pixels_are_where_the_shapes_are() -> None:
    pixels = Drawing(100, 50, SHAPES).pixels()
    assert pixels.shape == (100, 200, 3)
    assert pixels.dtype == np.uint8
    assert pixels[20, 100].tolist() == [255, 0, 0]
    assert pixels[60, 60].tolist() == [0, 0, 255]
    assert pixels[5, 5].tolist() == [255, 255, 255]
    words = np.argwhere((pixels[50:] < 100).all(2))
    assert len(words) > 20
    assert abs(words[:, 1].mean() - 120) < 10, "in the middle at x = 60"


def test_later_shapes_are_on_top() -> None:
    over = (Circle(20, 20, 6, "#00ff00"), Line(((0, 20), (40, 20)), "#000000", 2))
    assert Drawing(40, 40, over).pixels()[40, 40].tolist() == [0, 0, 0]
    assert Drawing(40, 40, over[::-1]).pixels()[40, 40].tolist() == [0, 255, 0]
