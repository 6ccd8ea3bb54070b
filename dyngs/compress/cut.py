"""Cuts of a trained scene: Gaussians, faint blending, control nodes and pieces of splines,
harmonics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.compress.stage import removal
from dyngs.config import AutoColour, Config
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import innermost, with_innermost
from dyngs.deform.keys import ControlNodesField, DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.colour.training import HELD_OUT_EVERY, MeasuredView, find_view_dependent
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.views import background_colour
from dyngs.ops.device import sent
from dyngs.training.new_trainer import GaussianTrainer
from dyngs.training.trainer import Edit


@dataclass(frozen=True)
class FieldSize:
    """Size of a field of control nodes."""

    nodes: int
    pieces: int


@dataclass(frozen=True)
class Cut:
    """A choice of parts to take away; the defaults take nothing."""

    fraction: float = 0.0  # of the Gaussians that is removed
    # pixels skip Gaussians with a lower alpha; None: as the run has it
    alpha_min: float | None = None
    field: FieldSize | None = None  # size of the field of control nodes; None: as it is
    # PSNR that view dependence may cost on training views before fine-tuning, dB; 0: all harmonics
    # stay
    harmonics: float = 0.0

    def __str__(self) -> str:
        words = [f"{self.fraction:.1%} of the Gaussians"] if self.fraction else []
        words += [f"alphas below {self.alpha_min:.3g}"] if self.alpha_min else []
        words += (
            [f"all but {self.field.nodes} nodes of {self.field.pieces} pieces"]
            if self.field
            else []
        )
        words += [f"harmonics worth {self.harmonics:g} dB"] if self.harmonics else []
        return ", ".join(words) or "nothing"


def field_size(scene: GaussianScene) -> FieldSize | None:
    """Return the size of the field of ``scene``; None where no control nodes move anything."""
    nodes = _nodes_of(scene)
    return (
        FieldSize(nodes.num_nodes, nodes.num_pieces)
        if nodes is not None and nodes.num_nodes
        else None
    )


def with_field(scene: GaussianScene, size: FieldSize) -> GaussianScene:
    """Return ``scene`` with so many of its nodes and pieces; as it is where no control nodes move
    anything."""
    nodes = _nodes_of(scene)
    if nodes is None or not isinstance(scene, DynamicScene) or scene.field is None:
        return scene
    reduced = nodes.reduced(size.nodes, size.pieces, scene.gaussians.means.detach()[scene.moving])
    return replace(scene, field=with_innermost(scene.field, reduced))


def _nodes_of(scene: GaussianScene) -> ControlNodes | None:
    if not isinstance(scene, DynamicScene) or scene.field is None or scene.is_static:
        return None
    field = innermost(scene.field)
    return field if isinstance(field, ControlNodes) else None


def cut_config(config: Config, cut: Cut) -> Config:
    """Return the configuration of what ``apply_cut`` leaves."""
    model = config.model
    match model:
        case DynamicModel(deform=ControlNodesField() as deform) if cut.field is not None:
            size = {"nodes": cut.field.nodes, "pieces": cut.field.pieces}
            model = model.model_copy(update={"deform": deform.model_copy(update=size)})
        case _:
            pass
    if cut.alpha_min is not None:
        model = model.model_copy(update={"alpha_min": cut.alpha_min})
    colour = config.colour
    if cut.harmonics:
        colour = AutoColour(opacity_entropy=colour.opacity_entropy)
    prune = config.prune.model_copy(update={"fraction": cut.fraction})
    return config.model_copy(update={"model": model, "colour": colour, "prune": prune})


def apply_cut(trainer: GaussianTrainer, cut: Cut, scores: Tensor) -> None:
    """Take away what ``cut`` says from the scene of ``trainer``, which is at the end of its run."""
    trainer.apply(Edit(config=cut_config(trainer.config, replace(cut, field=None))))
    trainer.apply(removal(trainer, scores if cut.fraction else None))
    if cut.field is not None and _nodes_of(trainer.model.scene) is not None:
        # else nothing that moves is left
        trainer.apply(Edit(config=cut_config(trainer.config, cut)))
        trainer.model.exchange(with_field(trainer.model.scene, cut.field))
    if cut.harmonics:
        _drop_harmonics(trainer, cut.harmonics)


def _drop_harmonics(trainer: GaussianTrainer, tolerance: float) -> None:
    usable = [i for i in range(len(trainer.images)) if i not in trainer.held_out]
    judged = usable[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY] or usable[:1]
    seen = [i for i in usable if i not in judged] or judged
    background = sent(background_colour(trainer.background), trainer.device)
    looks = list(_looks(trainer, judged, background))
    found = find_view_dependent(
        _looks(trainer, seen, background), looks, trainer.model.options, background, tolerance
    )
    trainer.model.drop_harmonics(~found.keeps, found.offsets)
    trainer.model.keep_plain(
        ~found.keeps, AutoColour(opacity_entropy=trainer.config.colour.opacity_entropy)
    )


def _looks(
    trainer: GaussianTrainer, indices: Sequence[int], background: Tensor
) -> Iterator[MeasuredView]:
    for image in (trainer.images[i] for i in indices):
        with torch.no_grad():
            now = trainer.model.training.time_step(
                trainer.model.scene, image, trainer.done
            ).gaussians.detach()
        yield MeasuredView(now, image.cameras, image.composite(background), image.mask)
