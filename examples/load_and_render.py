"""Load a run, render a view of its capture, and write a camera path.

python examples/load_and_render.py runs/plush
"""

from __future__ import annotations

import sys
from pathlib import Path

import dyngs
from dyngs.data.loader import ImageLoader

scene = dyngs.load(sys.argv[1])
print(scene)

capture = dyngs.read_capture(scene.run.config.data)
image = ImageLoader(capture.splits["test"])[0]
rendering = scene.render(image.cameras, time=image.time)
Path("first.png").write_bytes(rendering._repr_png_())  # what a notebook shows

written = dyngs.render_path(scene, "orbit", out="orbit", frames=12)
print(f"{len(written)} images in {written[0].parent}")
