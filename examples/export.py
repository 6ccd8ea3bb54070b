"""Export a run for other programs, and save a changed scene.

python examples/export.py runs/plush
"""

from __future__ import annotations

import sys

import dyngs

run = sys.argv[1]
for name in ("scene.spz", "scene.html"):
    print(dyngs.export(run, name))
print(dyngs.export(run, "scene.glb", format="mesh", cells=48))

scene = dyngs.load(run)
visible = scene.select(scene.gaussians.opacities > 0.05)
print(dyngs.save(visible, "visible.ply"), dyngs.load("visible.ply"))
