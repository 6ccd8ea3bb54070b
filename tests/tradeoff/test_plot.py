"""The plot is well-formed, shows every point inside its panels, and survives odd figures."""

from __future__ import annotations

from xml.etree import ElementTree

from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.tradeoff.knobs import Variant
from dyngs.tradeoff.plot import svg
from dyngs.tradeoff.requirements import Figures

SPACE = "{http://www.w3.org/2000/svg}"


def figures(variant: Variant, psnr: float, fps: float, mb: float) -> Figures:
    return Figures(variant, psnr, 0.9, None, fps, mb, None, 10)


@settings(deadline=None)  # the first call imports
@given(st.lists(st.tuples(st.floats(-10, 100), st.floats(1e-3, 1e5), st.floats(1e-4, 1e4)), min_size=1, max_size=8))
def test_every_point_lies_inside(values: list[tuple[float, float, float]]) -> None:
    points = [figures(Variant(prune=i / 10), *v) for i, v in enumerate(values)]
    picture = ElementTree.fromstring(svg(points))
    width, height = float(picture.attrib["width"]), float(picture.attrib["height"])
    dots = [c for c in picture.iter(f"{SPACE}circle") if c.find(f"{SPACE}title") is not None]
    assert len(dots) == 2 * len(points)
    assert all(0 < float(c.attrib["cx"]) < width and 0 < float(c.attrib["cy"]) < height for c in dots)


def test_cut_offs_are_hollow_and_points_have_names() -> None:
    points = [figures(Variant(), 30, 10, 5), figures(Variant(alpha_min=0.01), 29, 15, 5)]
    text = svg(points)
    assert "alpha_min=0.01: 29.00 dB, 15.0 fps, 5.00 MB" in text
    assert text.count('fill="white" stroke=') == 2
    assert "http" not in text.replace("http://www.w3.org/2000/svg", ""), "nothing is fetched"


def test_faster_and_smaller_are_the_front() -> None:
    points = [
        figures(Variant(), 30, 10, 5),
        figures(Variant(prune=0.5), 29, 20, 2),
        figures(Variant(scale=0.5), 28, 5, 9),
    ]
    lines = [p.attrib["points"].split() for p in ElementTree.fromstring(svg(points)).iter(f"{SPACE}polyline")]
    assert [len(line) for line in lines] == [2, 2]
