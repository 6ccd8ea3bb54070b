"""Errors of runs near the true edges of the synthetic scene of polyhedra, and in its close-ups.

    dyngs data synth polyhedra FOLDER --size 200
    dyngs train bg_triangle data.root=FOLDER run.dir=RUN
    python benchmarks/edges.py RUN [RUN ...]

Prints for each run the numbers that it has learned, and of the splits test (as far away as the training views) and val
(40 % of that): PSNR of whole images, and of the pixels within 2 px of a true edge. Images have their stored size.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from dyngs.data.capture import Split, View
from dyngs.data.loader import ImageLoader
from dyngs.errors import DyngsError
from dyngs.models.renderable import Renderable
from dyngs.runs.opened import Opened, open_run
from dyngs.state import Role
from dyngs.triangles.scene import TriangleScene

NEAR = 2  # px from an edge
SPLITS: tuple[Split, ...] = ("test", "val")


def near_edges(root: Path, view: View) -> Tensor:
    """(H, W) bool: pixels within ``NEAR`` of a true edge. Raises DyngsError where there is no image of edges."""
    path = root / "edges" / f"{view.name}.png"
    if not path.is_file():
        raise DyngsError(f"{path}: there is no such file: edges are those of `dyngs data synth polyhedra`")
    edges = torch.from_numpy(np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)))[..., 0]
    return max_pool2d(edges[None, None], 2 * NEAR + 1, 1, NEAR)[0, 0] > 0.5


def num_values(scene: Renderable) -> int:
    """Return how many numbers were learned."""
    if isinstance(scene, TriangleScene):
        return scene.patches.num_values
    return sum(x.tensor.numel() for x in scene.state().values() if x.role is Role.PER_GAUSSIAN)


@torch.no_grad()
def errors(opened: Opened, split: Split) -> tuple[float, float]:
    """Return PSNR, mean over views, of whole images and near edges."""
    capture = opened.capture
    options = opened.config.data.model_copy(update={"downscale": 1.0, "longest_side": None})
    views = capture.splits[split]
    images, whole, near = ImageLoader(views, options), [], []
    for i, view in enumerate(views):
        image, background = images[i], opened.background
        rendered = opened.renderable.render(image.cameras, background=background).rgb[0].clamp(0, 1)
        squared = (rendered - image.composite(background)).square().mean(-1)
        whole.append(_psnr(squared))
        near.append(_psnr(squared[near_edges(Path(opened.config.data.root), view)]))
    return float(np.mean(whole)), float(np.mean(near))


def _psnr(squared: Tensor) -> float:
    return -10 * float(squared.mean().clamp_min(1e-10).log10())


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    for path in parser.parse_args(words).runs:
        opened = open_run(path)
        print(f"{path}: {num_values(opened.renderable):,} numbers")
        for split in SPLITS:
            whole, near = errors(opened, split)
            print(f"  {split}: {whole:.2f} dB, within {NEAR} px of edges {near:.2f} dB")


if __name__ == "__main__":
    main()
