"""Initial Gaussians from an existing scene, in the world of the capture."""

from __future__ import annotations

import torch

from dyngs.config import Config, SceneInit
from dyngs.core.errors import DyngsError, format_count, log_warning
from dyngs.data.capture import Capture
from dyngs.gaussians.initialization import InitialGaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.formats.similarity import IDENTITY, Similarity
from dyngs.io.formats.splat_file import with_sh_degree
from dyngs.runs.opened import open_scene


def load_initial_gaussians(config: Config, capture: Capture) -> InitialGaussians | None:
    """Load the Gaussians of ``init.scene`` in the coordinates of the capture; None for other kinds
    of initialisation.

    Raises DyngsError: an unreadable scene, or no Gaussians in ``init.box``.
    """
    init = config.init
    if not isinstance(init, SceneInit):
        return None
    opened = open_scene(init.scene, nonfinite="skip", with_capture=False)
    scene = opened.scene.to("cpu")
    if not scene.is_static:
        raise DyngsError(
            f"{init.scene}: a moving scene; training starts from static scenes, "
            "make one with `dyngs export --time T`"
        )
    has_filter = isinstance(scene, StaticScene) and scene.filter_std is not None
    keeps_filter = has_filter and config.model.filter_3d
    gaussians = scene.gaussians.detach() if keeps_filter else scene.at(None)
    x, y, z = capture.world_offset.tolist()
    how = Similarity(scale=capture.world_scale, shift=(x, y, z)).inverse().after(opened.world)
    gaussians = gaussians if how == IDENTITY else how.gaussians(gaussians)
    gaussians = with_sh_degree(gaussians, config.stored_sh_degree)
    frozen = None
    if init.box is not None:
        low, high = torch.tensor(init.box, dtype=torch.float64, device="cpu").reshape(2, 3)
        means = torch.from_numpy(opened.world.points(scene.at(None).means.numpy()))
        frozen = ~((means >= low) & (means <= high)).all(1)
        if bool(frozen.all()):
            raise DyngsError(
                f"init.box: none of {format_count(len(scene), 'Gaussian')} of {init.scene} lie in it"
            )
    mode = scene.options.mode
    if mode is not config.model.rasterize_mode:
        log_warning(
            f"{init.scene}: was trained with model.rasterize_mode={mode.value}, unlike this run"
        )
    return InitialGaussians(gaussians, frozen)
