"""The plot shows every point inside its panels, and survives odd figures."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.tradeoff.plot import plot
from dyngs.tradeoff.table import TableRow
from dyngs.tradeoff.variants import Variant
from dyngs.tradeoff.vector_graphics import Circle, Line, Text


def row(variant: Variant, psnr: float, fps: float, mb: float) -> TableRow:
    return TableRow(variant, psnr, 0.9, None, fps, 1.0, 1.0, 1.0, 1e3 / fps, mb, None, 10, True)


@settings(deadline=None)  # the first call imports
@given(st.lists(st.tuples(st.floats(-10, 100), st.floats(1e-3, 1e5), st.floats(1e-4, 1e4)), min_size=1, max_size=8))
def test_every_point_lies_inside(values: list[tuple[float, float, float]]) -> None:
    rows = [row(Variant(prune=i / 10), *v) for i, v in enumerate(values)]
    drawing = plot(rows)
    dots = [shape for shape in drawing.shapes if isinstance(shape, Circle) and shape.tip]
    assert len(dots) == 2 * len(rows)
    assert all(0 < dot.x < drawing.width and 0 < dot.y < drawing.height for dot in dots)


def test_points_have_names() -> None:
    rows = [row(Variant(), 30, 10, 5), row(Variant(alpha_min=0.01), 29, 15, 5)]
    assert "alpha_min=0.01: 29.00 dB, 15.0 fps, 5.00 MB" in plot(rows).svg()
    labels = [shape.text for shape in plot(rows).shapes if isinstance(shape, Text)]
    assert {"the run itself", "alpha_min"} <= set(labels)


def test_lines_join_the_front_and_the_values_of_a_setting() -> None:
    """Pruning is faster and smaller; the smaller image is neither, but a line leads there, too."""
    rows = [
        row(Variant(), 30, 10, 5),
        row(Variant(prune=0.5), 29, 20, 2),
        row(Variant(prune=0.7), 28, 30, 1),
        row(Variant(scale=0.5), 28, 5, 9),
    ]
    lines = [shape for shape in plot(rows).shapes if isinstance(shape, Line)]
    lengths = [len(line.points) for line in lines if line.width > 1]
    assert lengths == [3, 3]
    assert sorted(len(line.points) for line in lines if line.width < 1) == [2, 2, 3, 3]
    faster = next(line for line in lines if line.width < 1).points
    assert list(faster) == sorted(faster), "in the order of the values"
