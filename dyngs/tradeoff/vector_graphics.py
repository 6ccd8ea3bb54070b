"""Drawings made of lines, circles and text, as SVG and as pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from PIL import ImageDraw

PIXELS = 2
"""Pixels per unit of a drawing."""
SUPERSAMPLING = 2
"""Images are drawn larger by this factor and reduced, which smooths their edges."""
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}
_INK = "#222222"


@dataclass(frozen=True)
class Line:
    """A line through ``points``, (x, y) from the upper left."""

    points: tuple[tuple[float, float], ...]
    colour: str
    width: float


@dataclass(frozen=True)
class Circle:
    """A filled circle with a white rim; ``tip`` is its tooltip."""

    x: float
    y: float
    radius: float
    colour: str
    tip: str = ""


@dataclass(frozen=True)
class Text:
    """A line of text whose baseline starts, ends or is centred at (x, y)."""

    x: float
    y: float
    text: str
    anchor: Literal["start", "middle", "end"] = "start"
    size: float = 12
    bold: bool = False


Shape = Line | Circle | Text


@dataclass(frozen=True)
class Drawing:
    """Shapes on a white background, later ones on top."""

    width: int
    height: int
    shapes: Sequence[Shape]

    def svg(self) -> str:
        """Return the drawing as an SVG file."""
        size = f'viewBox="0 0 {self.width} {self.height}" width="{self.width}" height="{self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" fill="{_INK}">'
        paper = f'<rect width="{self.width}" height="{self.height}" fill="white"/>'
        return "\n".join([head, paper, *(_element(shape) for shape in self.shapes), "</svg>"]) + "\n"

    def pixels(self) -> np.ndarray:
        """Return the drawing as (2 height, 2 width, 3) uint8."""
        from PIL import Image, ImageDraw

        scale = PIXELS * SUPERSAMPLING
        image = Image.new("RGB", (scale * self.width, scale * self.height), "white")
        pen = ImageDraw.Draw(image)
        for shape in self.shapes:
            _draw(pen, shape, scale)
        return np.asarray(image.reduce(SUPERSAMPLING))


def _element(shape: Shape) -> str:
    if isinstance(shape, Line):
        joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in shape.points)
        return f'<polyline points="{joined}" fill="none" stroke="{shape.colour}" stroke-width="{shape.width}"/>'
    if isinstance(shape, Circle):
        tip = f"<title>{escape(shape.tip)}</title>" if shape.tip else ""
        place = f'cx="{shape.x:.1f}" cy="{shape.y:.1f}" r="{shape.radius}"'
        return f'<circle {place} fill="{shape.colour}" stroke="white">{tip}</circle>'
    weight = ' font-weight="bold"' if shape.bold else ""
    style = f'text-anchor="{shape.anchor}" font-size="{shape.size}"{weight}'
    return f'<text x="{shape.x:.1f}" y="{shape.y:.1f}" {style}>{escape(shape.text)}</text>'


def _draw(pen: ImageDraw.ImageDraw, shape: Shape, scale: int) -> None:
    """Draw one shape, magnified by ``scale``."""
    from PIL import ImageFont

    if isinstance(shape, Line):
        points = [(scale * x, scale * y) for x, y in shape.points]
        pen.line(points, fill=shape.colour, width=round(scale * shape.width), joint="curve")
    elif isinstance(shape, Circle):
        pen.circle((scale * shape.x, scale * shape.y), scale * (shape.radius + 0.5), fill="white")
        pen.circle((scale * shape.x, scale * shape.y), scale * (shape.radius - 0.5), fill=shape.colour)
    else:
        font = ImageFont.load_default(scale * shape.size)
        place, weight = (scale * shape.x, scale * shape.y), round(scale * 0.25) if shape.bold else 0
        pen.text(place, shape.text, fill=_INK, font=font, anchor=_ANCHORS[shape.anchor], stroke_width=weight)
