"""The plot shows every point inside its panels, and survives odd figures."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.study.plots import png_of, svg_of
from dyngs.study.tradeoff.plot import plot
from dyngs.study.tradeoff.table import TableRow
from dyngs.study.tradeoff.variants import Variant

pytest.importorskip("matplotlib")


def row(variant: Variant, psnr: float, fps: float, mb: float) -> TableRow:
    return TableRow(variant, psnr, 0.9, None, fps, 1.0, 1.0, 1.0, 1e3 / fps, mb, None, 10, True)


@settings(max_examples=2)  # a drawing takes a while
@given(
    st.lists(
        st.tuples(st.floats(-10, 100), st.floats(1e-3, 1e5), st.floats(1e-4, 1e4)),
        min_size=1,
        max_size=8,
    )
)
def test_every_point_lies_inside(values: list[tuple[float, float, float]]) -> None:
    rows = [row(Variant(prune=i / 10), *v) for i, v in enumerate(values)]
    figure = plot(rows)
    png_of(figure)
    for axes in figure.axes:
        dots = [line for line in axes.lines if line.get_gid()]
        assert len(dots) == len(rows)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        for dot in dots:
            assert left < dot.get_xdata()[0] < right
            assert low < dot.get_ydata()[0] < high


def test_points_have_names_and_nothing_is_fetched() -> None:
    rows = [row(Variant(), 30, 10, 5), row(Variant(alpha_min=0.01), 29, 15, 5)]
    text = svg_of(plot(rows))
    assert text == svg_of(plot(rows))
    root = ElementTree.fromstring(text)
    texts = [(element.text or "").strip() for element in root.iter()]
    assert texts.count("alpha_min=0.01: 29.00 dB, 15.0 fps, 5.00 MB") == 2, (
        "a tooltip in each panel"
    )
    assert {"the run itself", "alpha_min", "PSNR and speed"} <= set(texts)
    assert "<image" not in text
    assert 'href="http' not in text


def test_lines_join_the_front_and_the_values_of_a_setting() -> None:
    """Pruning is faster and smaller; the smaller image is neither, but a line leads there, too."""
    rows = [
        row(Variant(), 30, 10, 5),
        row(Variant(prune=0.5), 29, 20, 2),
        row(Variant(prune=0.7), 28, 30, 1),
        row(Variant(scale=0.5), 28, 5, 9),
    ]
    lines = [line for axes in plot(rows).axes for line in axes.lines if line.get_linestyle() == "-"]
    joining = [line for line in lines if line.get_marker() == "None"]
    assert [len(line.get_xdata()) for line in joining if line.get_linewidth() > 1] == [3, 3]
    thin = [line for line in joining if line.get_linewidth() < 1]
    assert sorted(len(line.get_xdata()) for line in thin) == [2, 2, 3, 3]
    assert list(thin[0].get_xdata()) == [10, 20, 30], "in the order of the values"
