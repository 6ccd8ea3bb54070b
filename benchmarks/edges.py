"""Errors of runs at the stored size of their images: whole, near true edges, and in close-ups.

    python benchmarks/polyhedra.py FOLDER --size 200
    dyngs train bg_triangle data.root=FOLDER run.dir=RUN
    python benchmarks/edges.py RUN [RUN ...]

Prints for each run the numbers that it has learned, and PSNR, SSIM and FLIP of the splits test and
val; where the capture has images of true edges (the synthetic scene of polyhedra), PSNR of the pixels
within 2 px of one, too. There, val are close-ups from 40 % of the distance; other captures are
enlarged as much by a run at 40 % of their size.
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

from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.metrics import flip, ssim
from dyngs.core.state import Role
from dyngs.data.capture import Split, View
from dyngs.data.loader import ImageLoader
from dyngs.models.renderable import Renderable
from dyngs.runs.opened import OpenedScene, open_run

NEAR = 2  # px from an edge
SPLITS: tuple[Split, ...] = ("test", "val")


def near_edges(root: Path, view: View) -> Tensor | None:
    """(H, W) bool: pixels within ``NEAR`` of a true edge; None where there is no image of edges."""
    path = root / "edges" / f"{view.name}.png"
    if not path.is_file():
        return None
    edges = torch.from_numpy(np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)))[..., 0]
    return max_pool2d(edges[None, None], 2 * NEAR + 1, 1, NEAR)[0, 0] > 0.5


def num_values(scene: Renderable) -> int:
    """Return how many numbers were learned."""
    if isinstance(scene, TriangleScene):
        return scene.patches.num_values
    return sum(x.tensor.numel() for x in scene.state().values() if x.role is Role.PER_GAUSSIAN)


@torch.no_grad()
def errors(opened: OpenedScene, split: Split) -> list[float]:
    """Return means over views: PSNR, SSIM and FLIP of whole images, and PSNR near edges, NaN where
    there is none."""
    options = opened.config.data.model_copy(update={"downscale": 1.0, "longest_side": None})
    views = opened.capture.splits[split]
    images = ImageLoader(views, options)
    found = []
    for i, view in enumerate(views):
        image = images[i]
        background = opened.background
        rendered = opened.renderable.render(image.cameras, background=background).rgb[0].clamp(0, 1)
        truth = image.composite(background)
        squared = (rendered - truth).square().mean(-1)
        near = near_edges(Path(opened.config.data.root), view)
        beside = float("nan") if near is None else _psnr(squared[near])
        perceived = flip(rendered, truth).value
        different = float("nan") if perceived is None else perceived
        found.append([_psnr(squared), ssim(rendered, truth), different, beside])
    return np.mean(found, axis=0).tolist()


def _psnr(squared: Tensor) -> float:
    return -10 * float(squared.mean().clamp_min(1e-10).log10())


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    for path in parser.parse_args(words).runs:
        opened = open_run(path)
        print(f"{path}: {num_values(opened.renderable):,} numbers")
        for split in SPLITS:
            if opened.capture.splits[split]:
                whole, alike, different, near = errors(opened, split)
                print(
                    f"  {split}: {whole:.2f} dB, SSIM {alike:.4f}, FLIP {different:.4f}, "
                    f"within {NEAR} px of edges {near:.2f} dB"
                )


if __name__ == "__main__":
    main()
