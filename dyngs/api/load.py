"""Load anything that dyngs writes, or any file of Gaussians, as a scene."""

from __future__ import annotations

from pathlib import Path

from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import open_scene


def load(path: Path | str) -> GaussianScene:
    """Load a scene, to be drawn from anywhere, at any time.

    Example::

        import torch

        import dyngs

        scene = dyngs.load("runs/lego")
        pose = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]])
        camera = dyngs.Cameras(pose, torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]), 64, 48)
        image = scene.render(camera, time=0.5).rgb[0]

    Args:
        path: a run folder (its newest checkpoint, or its ``scene.dyngs``), a ``scene.dyngs`` with the ``config.yaml``
            of its run next to it, an avatar file (``.safetensors``), or a file of Gaussians such as a 3DGS ``.ply``.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    return open_scene(Path(path)).scene
