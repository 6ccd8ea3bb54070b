"""Train with a loss of your own: edges of the rendering are compared with those of the photo.

python examples/own_loss.py PHOTOS 7000
"""

from __future__ import annotations

import sys

from torch import Tensor

import dyngs


def edges(look: dyngs.LossInput) -> Tensor:
    """Return the weighted difference of horizontal gradients, of pixels that the mask keeps."""
    error = (look.rendered.diff(dim=1) - look.truth.diff(dim=1)).abs()
    if look.image.mask is not None:
        error = error * look.image.mask[:, 1:, None]
    return 0.1 * error.mean()


capture, steps = sys.argv[1], int(sys.argv[2])
scene = dyngs.train("static", data=capture, steps=steps, run_dir="runs/edges", losses=[edges])
scene = dyngs.train(resume="runs/edges", steps=2 * steps, losses=[edges])  # passed again
print(scene, scene.run.step)
