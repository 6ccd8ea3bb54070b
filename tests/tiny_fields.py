"""Deformation fields of every kind, small enough to test, and Gaussians for them to move."""

from __future__ import annotations

import torch
from scenes import random_scene

from dyngs.config import HexplaneField, MlpField, TrajectoryField
from dyngs.deform.field import DeformationField, FieldSetup
from dyngs.deform.fields import FieldOptions, new_field
from dyngs.gaussians import Gaussians

KINDS = ("hexplane", "mlp", "nodes", "trajectory")
"""``nodes`` is the perceptron evaluated at control nodes."""
HEADS = ("move_rotations", "move_scales", "move_opacities", "move_colors")
TIMES = (0.0, 0.37, 1.0)


def tiny_options(kind: str, *, everything: bool = True) -> FieldOptions:
    """Options of a field that moves every attribute, or only positions."""
    heads = dict.fromkeys(HEADS, everything)
    if kind == "hexplane":
        return HexplaneField(channels=3, resolution=5, levels=(1, 2), width=8, **heads)
    if kind == "trajectory":
        return TrajectoryField(polynomial=2, fourier=1, **heads)
    nodes = 4 if kind == "nodes" else 0
    return MlpField(depth=2, width=8, nodes=nodes, space_frequencies=2, time_frequencies=2, **heads)


def tiny_setup(num_moving: int = 9, num_times: int = 10) -> FieldSetup:
    """A box of half side 2 around the origin."""
    return FieldSetup(torch.zeros(3), torch.full((3,), 2.0), num_times, num_moving, 1.5)


def tiny_field(kind: str, num_moving: int = 9, *, everything: bool = True) -> DeformationField:
    """An untrained field."""
    generator = torch.Generator().manual_seed(3)
    return new_field(tiny_options(kind, everything=everything), tiny_setup(num_moving), generator)


def stirred_field(kind: str, num_moving: int = 9, *, size: float = 0.2, everything: bool = True) -> DeformationField:
    """A field as after training: all that is learned has some noise on it."""
    field = tiny_field(kind, num_moving, everything=everything)
    generator = torch.Generator().manual_seed(4)
    for x in field.learned.values().values():
        x += size * torch.randn(x.shape, generator=generator)
    return field


def cloud(count: int = 9, seed: int = 0) -> Gaussians:
    """Random float32 Gaussians around the origin, of SH degree 1."""
    return random_scene(n=count, seed=seed).to(torch.float32).gaussians
