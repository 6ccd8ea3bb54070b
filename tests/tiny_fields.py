"""Deformation fields of every kind, small enough to test, and Gaussians for them to move."""

from __future__ import annotations

from pathlib import Path

import torch
from scenes import random_scene
from torch import Tensor

from dyngs.config import Config, DataConfig, DefaultStrategy, RandomInit, RunConfig, TrainConfig
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.deform.control_nodes import Nodes, blend_node_motion
from dyngs.deform.field import DeformationField, FieldSetup, MovingRows, Offsets, innermost
from dyngs.deform.fields import create_field
from dyngs.deform.keys import (
    ControlNodesField,
    DeformField,
    DynamicModel,
    FreeField,
    Gaussians4DField,
    HexplaneField,
    MlpField,
)
from dyngs.gaussians import Gaussians
from dyngs.ops.quaternions import identity_quat

KINDS = ("hexplane", "mlp", "control_nodes")  # fields that begin as the identity
ALL_KINDS = (*KINDS, "free", "gaussians_4d")
HEADS = ("rotations", "scales", "opacities", "colors")
TIMES = (0.0, 0.37, 1.0)


def tiny_options(kind: str, *, everything: bool = True) -> DeformField:
    """Options of a field that moves every attribute, or only positions."""
    moves = HEADS if everything else ()
    if kind == "hexplane":
        return HexplaneField(channels=3, resolution=5, levels=(1, 2), width=8, moves=moves)
    if kind == "control_nodes":
        return ControlNodesField(nodes=5, pieces=3, moves=moves)
    if kind == "free":
        return FreeField()
    if kind == "gaussians_4d":
        return Gaussians4DField(frequencies=2)
    return MlpField(depth=2, width=8, moves=moves)


def tiny_setup(num_moving: int = 9, num_times: int = 10) -> FieldSetup:
    """A box of half side 2 around the origin, with Gaussians of SH degree 1."""
    return FieldSetup(torch.zeros(3), torch.full((3,), 2.0), num_times, num_moving, 1.5, 4)


def tiny_field(kind: str, num_moving: int = 9, *, everything: bool = True) -> DeformationField:
    """An untrained field."""
    generator = torch.Generator().manual_seed(3)
    return create_field(
        tiny_options(kind, everything=everything), tiny_setup(num_moving), generator
    )


def stirred_field(
    kind: str, num_moving: int = 9, *, size: float = 0.2, everything: bool = True
) -> DeformationField:
    """A field as after training: all that is learned has some noise on it, and no unit of the
    networks is silent.

    Control nodes lie among the first means of ``cloud``.
    """
    field = tiny_field(kind, num_moving, everything=everything)
    moved(field, cloud(num_moving), 0.0)
    stir(field, size)
    return field


def moved(
    field: DeformationField, gaussians: Gaussians, time: float, rows: Tensor | None = None
) -> Gaussians:
    """The Gaussians at a time: a field moves their ``rows``, or all."""
    means = gaussians.means if rows is None else gaussians.means[rows]
    return field.deform(gaussians, MovingRows(means, None, rows), time).gaussians


def followed(nodes: Nodes, means: Tensor, at_nodes: Offsets) -> Offsets:
    """Return the offsets that ``follow`` computes from offsets of the nodes."""
    heads = {name: x.reshape(len(x), -1) for name, x in vars(at_nodes).items() if x is not None}
    shifts = heads.pop("means")
    turns = identity_quat(shifts).expand(len(shifts), 4) + heads.get("quats", 0)
    values = torch.cat([shifts[:, :0], *heads.values()], 1)
    sizes = {name: x.shape[1] for name, x in heads.items()}
    return blend_node_motion(nodes, means, torch.cat([shifts, turns], 1), values, sizes)


def stir(field: DeformationField, size: float = 0.2) -> None:
    """Put noise on all that is learned."""
    generator = torch.Generator().manual_seed(4)
    for name, x in innermost(field).parameters.values().items():
        noise = size * torch.randn(x.shape, generator=generator)
        x += noise.abs() if name.startswith(("bias", "space")) else noise


def cloud(count: int = 9, seed: int = 0) -> Gaussians:
    """Random float32 Gaussians around the origin, of SH degree 1."""
    return random_scene(n=count, seed=seed).to(torch.float32).gaussians


def write_tiny_capture(root: Path) -> Path:
    """Sixteen images of 24x24 px of a scene in which a die turns and a ball rolls."""
    options = DynamicOptions(size=24, num_times=16, num_test=1, samples=1)
    return write_dynamic_capture("spin", root, options)


def busy_config(capture: Path, run_dir: Path, kind: str, **model: object) -> Config:
    """A run of 24 steps in which all happens: motion begins after step 8, all times come from 14
    on, splits from 15 on.

    Of the 60 Gaussians some may move, and so may 12 random ones; the set changes each third step.
    The field learns so fast that after some steps a part of what may move is seen to.
    """
    rates = {
        "hexplane": {"lr_planes": 1e-1, "lr_decoder": 5e-2},
        "mlp": {"lr": 1e-2},
        "control_nodes": {"lr_means": 1e-2},
        "free": {},
        "gaussians_4d": {"time_grad_threshold": 1e-8},
    }
    field = tiny_options(kind).model_copy(update=rates[kind])
    freeze_below_px = {"control_nodes": 1.5, "free": 0.05}.get(kind, 0.6)
    phases = {
        "motion_from": 8 / 24,
        "time_window": 0.4,
        "time_window_full_at": 14 / 24,
        "motion_threshold": 0.1,
        "num_random_moving": 12,
    }
    options = {
        "sh_degree": 1,
        "deform": field,
        "freeze_below_px": freeze_below_px,
        **phases,
        **model,
    }
    return Config(
        data=DataConfig(root=capture),
        model=DynamicModel.model_validate(options),
        init=RandomInit(num_random=60),
        strategy=DefaultStrategy(
            start=1,
            stop=30_000,
            every=3,
            grad_threshold=1e-6,
            reset_every=5,
            max_gaussians=500 if kind == "gaussians_4d" else 300,
        ),
        train=TrainConfig(steps=24, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )
