"""Trainings that go on from a scene: its Gaussians in the world of the capture, and which of them
stay as they are."""

from __future__ import annotations

import torch

from dyngs.config import AutoColour, Config, FixedStrategy, SceneInit, ShColour
from dyngs.core.errors import DyngsError, counted, show
from dyngs.data.capture import Capture
from dyngs.gaussians.start import FirstGaussians
from dyngs.io.formats.similarity import UNMOVED, Similarity
from dyngs.io.formats.splat_file import with_degree
from dyngs.models.kind import kind_of
from dyngs.runs.opened import open_scene
from dyngs.static.scene import StaticScene


def settled(config: Config) -> Config:
    """Return the configuration of a run that goes on from a scene, without what would first take it
    apart.

    Images are whole from the start; with frozen Gaussians none are removed and all keep their
    harmonics. Raises DyngsError: it is no model of a still scene.
    """
    init = config.init
    if not isinstance(init, SceneInit):
        return config
    if "init.scene" not in kind_of(config.model).uses:
        raise DyngsError(
            f"init.kind=scene goes with model.kind=static, not with {config.model.kind}"
        )
    keeps = init.trains == "colour" or init.box is not None
    train = {"initial_downscale": 1} | ({"remove_floaters": False} if keeps else {})
    changes: dict[str, object] = {"train": config.train.model_copy(update=train)}
    if init.trains == "colour":
        changes["strategy"] = FixedStrategy()
    if keeps and isinstance(config.colour, AutoColour):
        changes["colour"] = ShColour(opacity_entropy=config.colour.opacity_entropy)
    return config.model_copy(update=changes)


def first_of(config: Config, capture: Capture) -> FirstGaussians | None:
    """Return the Gaussians that ``init.scene`` names, as the capture has them; None: the run begins
    with points.

    Raises DyngsError: it cannot be read, or nothing of it lies in ``init.box``.
    """
    init = config.init
    if not isinstance(init, SceneInit):
        return None
    opened = open_scene(init.scene, nonfinite="skip")
    scene = opened.scene.to("cpu")
    if not scene.is_static:
        raise DyngsError(
            f"{init.scene}: moves; a training goes on from a still scene (dyngs export --time T makes one)"
        )
    keeps_filter = (
        isinstance(scene, StaticScene) and scene.filter_std is not None and config.model.filter_3d
    )
    gaussians = scene.gaussians.detach() if keeps_filter else scene.at(None)
    x, y, z = capture.world_offset.tolist()
    how = Similarity(scale=capture.world_scale, shift=(x, y, z)).inverse().after(opened.world)
    gaussians = gaussians if how == UNMOVED else how.gaussians(gaussians)
    gaussians = with_degree(gaussians, config.stored_sh_degree)
    frozen = None
    if init.box is not None:
        low, high = torch.tensor(init.box, dtype=torch.float64, device="cpu").reshape(2, 3)
        means = torch.from_numpy(opened.world.points(scene.at(None).means.numpy()))
        frozen = ~((means >= low) & (means <= high)).all(1)
        if bool(frozen.all()):
            raise DyngsError(
                f"init.box: none of {counted(len(scene), 'Gaussian')} of {init.scene} lie in it"
            )
    if scene.options.mode is not config.model.rasterize_mode:
        show(
            f"{init.scene}: was trained with model.rasterize_mode={scene.options.mode.value}, which is not this run's"
        )
    held = "" if frozen is None else f", of which {int(frozen.sum()):,} stay as they are"
    show(f"begins with {counted(len(gaussians), 'Gaussian')} of {init.scene}{held}")
    return FirstGaussians(gaussians, frozen)
