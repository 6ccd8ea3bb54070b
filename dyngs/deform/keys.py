"""Section ``model`` of moving scenes, and the deformation fields of ``model.deform``."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from dyngs.core.section import Fraction, Positive, SceneModel, Section

COPIES_OF_MOVING = 12_000
"""Copies over time of what moves in a static model, at most, that free primitives begin with."""


Attribute = Literal["rotations", "scales", "opacities", "colors"]


class FieldSection(Section):
    """Key that deformation fields share."""

    moves: tuple[Attribute, ...] = Field(
        default=("rotations", "scales"),
        description="what changes over time besides positions; with opacities things may appear and disappear",
    )

    @model_validator(mode="before")
    @classmethod
    def _read_flags(cls, given: Any) -> Any:
        """Read runs of earlier versions, which had a flag for each: ``move_rotations`` and so on."""
        flags = (
            {k: given[k] for k in given if k.startswith("move_")} if isinstance(given, dict) else {}
        )
        if not flags:
            return given
        usual = given.get("moves", cls.model_fields["moves"].default)
        moves = [
            x for x in get_args(Attribute) if flags.get(f"move_{x}", x in usual) in (True, "true")
        ]
        return {k: x for k, x in given.items() if k not in flags} | {"moves": moves}


class HexplaneField(FieldSection):
    """Planes over pairs of space and time axes and a small decoder (4DGS, Wu et al. 2024)."""

    kind: Literal["hexplane"] = Field(
        default="hexplane",
        description="feature planes over pairs of x, y, z, t and a small decoder (4DGS)",
    )
    channels: int = Field(default=32, ge=1, description="features per plane and level")
    resolution: int = Field(
        default=64, ge=2, description="cells of the first level's planes along x, y and z"
    )
    levels: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        default=(1, 2),
        min_length=1,
        description="one set of planes for each, with so many times that resolution",
    )
    width: int = Field(default=64, ge=1, description="neurons per hidden layer of the decoder")
    depth: int = Field(default=1, ge=1, description="hidden layers of the decoder before the heads")
    lr_planes: Positive = Field(
        default=1.6e-3, description="learning rate of the planes, times the scene extent"
    )
    lr_decoder: Positive = Field(
        default=1.6e-4, description="learning rate of the decoder, times the scene extent"
    )


class MlpField(FieldSection):
    """A multilayer perceptron on encoded position and time (Deformable-3DGS, Yang et al. 2024)."""

    kind: Literal["mlp"] = Field(
        default="mlp",
        description="a perceptron on encoded position and time (Deformable-3DGS); slow on a CPU",
    )
    depth: int = Field(default=8, ge=2, description="hidden layers")
    width: int = Field(default=256, ge=1, description="neurons per hidden layer")
    lr: Positive = Field(default=8e-4, description="learning rate")


class ControlNodesField(FieldSection):
    """Control nodes that move along splines, which Gaussians around them follow (after SC-GS, Huang
    et al. 2024)."""

    kind: Literal["control_nodes"] = Field(
        default="control_nodes",
        description="sparse control nodes on cubic splines, which Gaussians follow (after SC-GS); no network",
    )
    nodes: int = Field(default=512, ge=1, description="number of control nodes")
    pieces: int = Field(
        default=0,
        ge=0,
        description="polynomial pieces of each spline; 0: 0.3 times the number of training times",
    )
    lr_means: Positive = Field(
        default=6e-4, description="learning rate of the nodes' places, times the scene extent"
    )
    rigidity: float = Field(
        default=0.5,
        ge=0,
        description="weight of the as-rigid-as-possible term: squared strain between neighbouring nodes, in node "
        "spacings; lower where things bend",
    )


class FreeField(Section):
    """Gaussians that each have a moment, a span and a velocity of their own (after FreeTimeGS, Wang
    et al. 2025)."""

    kind: Literal["free"] = Field(
        default="free",
        description="each moving Gaussian has a moment, a span and a velocity of its own (after FreeTimeGS); for views "
        "of several cameras at each time",
    )


DeformField = HexplaneField | MlpField | ControlNodesField | FreeField


MIN_STATIC_STEPS = 1000
"""Steps that a static model needs to show where it fails; short runs spend at most a third on
it."""


class DynamicModel(SceneModel):
    """Canonical Gaussians and a deformation field over time (docs/dynamic.md)."""

    kind: Literal["dynamic"] = Field(
        default="dynamic",
        description="canonical Gaussians and a deformation field over time (docs/dynamic.md)",
    )
    deform: Annotated[
        DeformField,
        Field(discriminator="kind", description="how the canonical Gaussians are moved over time"),
    ] = HexplaneField()
    pilot_runs: bool = Field(
        default=False,
        description="whether pilot runs decide, on held-out training views, if the scene is trained "
        "as a static scene and, unless set, its colour representation",
    )
    motion_from: Fraction = Field(
        default=0.13,
        description="fraction of the run after which motion is learned; until then a static model is trained on all "
        "views, for 1000 steps or a third of the run at least (coarse stage of 4DGS)",
    )
    motion_threshold: float = Field(
        default=0.04,
        ge=0,
        description="colour error (0 to 1) of the static model from which Gaussians are taken to move",
    )
    num_random_moving: int = Field(
        default=4000,
        ge=0,
        description="Gaussians that are added among the moving ones when motion begins: random ones, or, for free "
        "primitives before fixed cameras, at most so many on things and as many on surfaces",
    )
    time_window: Fraction = Field(
        default=1.0,
        description="fraction of the training views, around the middle of the clip, that motion is first learned on; "
        "1: all at once",
    )
    time_window_grows_from: Fraction = Field(
        default=0.0, description="fraction of the run after which more views are added to these"
    )
    time_window_full_at: Fraction = Field(
        default=0.5, description="fraction of the run after which all views are trained on"
    )
    freeze_below_px: float = Field(
        default=0.3,
        ge=0,
        description="Gaussians that move by less than this many px in the nearest training view are frozen; 0: none",
    )
    motion_sparsity: float = Field(
        default=0.01,
        ge=0,
        description="weight of the mean displacement of the moving Gaussians, in scene extents",
    )

    @property
    def num_added_for_motion(self) -> int:
        if not isinstance(self.deform, FreeField):
            return self.num_random_moving
        return 2 * self.num_random_moving + COPIES_OF_MOVING

    def motion_start_step(self, steps: int) -> int:
        shortest = min(MIN_STATIC_STEPS, steps // 3)
        return min(max(1, round(self.motion_from * steps), shortest), steps)

    @property
    def bytes_per_moving_gaussian(self) -> int:
        # features from space-time grids, or neurons of a network, of each Gaussian
        return 200 if isinstance(self.deform, (ControlNodesField, FreeField)) else 2000
