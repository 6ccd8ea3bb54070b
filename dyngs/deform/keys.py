"""Config section ``model`` of dynamic scenes, and the deformation fields of ``model.deform``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dyngs.core.section import Fraction, Positive, SceneModel, Section

COPIES_OF_MOVING = 12_000
"""Most copies over time of the moving Gaussians that free primitives start with."""

CLIP_NODES = 2048, 1.2e-3
JUMPING_NODES = 512, 3e-4
"""Numbers of nodes and their learning rates, for clips and for cameras that jump.

In clips, neighbouring frames show a pose from nearly the same side, so that more and faster nodes
gain 0.9 and 0.5 dB on what moves (`clip_dog`, two seeds). Where cameras jump, each pose has one
image: the same nodes lose 2.5 dB on `flag`, and a rate of 3e-4 gains 1.0 and 1.7 dB (two seeds)
over 6e-4.
"""

Weight = Annotated[float, Field(ge=0)]
Attribute = Literal["rotations", "scales", "opacities", "colors"]


class FieldSection(Section):
    """Key shared by deformation fields."""

    moves: tuple[Attribute, ...] = Field(
        default=("rotations", "scales"),
        description="attributes that change over time besides positions; opacities let objects appear and disappear",
    )


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
        description="multiples of the resolution, one set of planes each",
    )
    width: int = Field(default=64, ge=1, description="neurons per hidden layer of the decoder")
    depth: int = Field(default=1, ge=1, description="hidden layers of the decoder before the heads")
    separate_heads: bool = Field(
        default=False,
        description="whether each attribute reads its own hidden units only, as in 4DGS",
    )
    times_per_row: Positive = Field(
        default=2, description="training times per row of the time planes; 4DGS: 4"
    )
    position_gradient: bool = Field(
        default=False,
        description="whether positions also receive the gradient through the planes, as in 4DGS",
    )
    penalty_weights: tuple[Weight, Weight, Weight] = Field(
        default=(1e-4, 0.01, 1e-4),
        description="weights of the smoothness of space planes, smoothness along time, and "
        "sparsity of time planes; 4DGS: 2e-4, 1e-3, 1e-4 for real captures",
    )
    lr_planes: Positive = Field(
        default=1.6e-3, description="learning rate of the planes, times the scene extent"
    )
    lr_decoder: Positive = Field(
        default=1.6e-4, description="learning rate of the decoder, times the scene extent"
    )
    lr_decay: Positive = Field(
        default=0.01,
        description="ratio of the last to the first learning rate; 4DGS: 0.1 for real captures",
    )


class MlpField(FieldSection):
    """An MLP on encoded position and time (Deformable-3DGS, Yang et al. 2024)."""

    kind: Literal["mlp"] = Field(
        default="mlp",
        description="an MLP on encoded position and time (Deformable-3DGS); slow on a CPU",
    )
    depth: int = Field(default=8, ge=2, description="hidden layers")
    width: int = Field(default=256, ge=1, description="neurons per hidden layer")
    time_frequencies: int = Field(
        default=6,
        ge=1,
        description="octaves of the encoding of time; Deformable-3DGS: 10 for real captures",
    )
    time_features: int = Field(
        default=0,
        ge=0,
        description="outputs of a network for time, whose outputs the MLP reads; 0: none; "
        "Deformable-3DGS: 30 for synthetic captures",
    )
    time_noise: float = Field(
        default=0,
        ge=0,
        description="standard deviation of the noise of training times, in frame intervals, at the "
        "start; it falls to 0 in half of the run; Deformable-3DGS: 0.1 for real captures",
    )
    lr: Positive = Field(default=8e-4, description="learning rate")


class ControlNodesField(FieldSection):
    """Control nodes on splines that nearby Gaussians follow (after SC-GS, Huang et al. 2024)."""

    kind: Literal["control_nodes"] = Field(
        default="control_nodes",
        description="sparse control nodes on cubic splines that Gaussians follow (after SC-GS); "
        "no network",
    )
    nodes: int = Field(
        default=0,
        ge=0,
        description="number of control nodes; 0: 2048 for clips, where successive cameras differ "
        "by less than 10 degrees, otherwise 512",
    )
    pieces: int = Field(
        default=0,
        ge=0,
        description="polynomial pieces per spline; 0: 0.3 times the number of training times",
    )
    lr_means: Positive | None = Field(
        default=None,
        description="learning rate of the node positions, times the scene extent; null: 1.2e-3 for "
        "clips, otherwise 3e-4",
    )
    rigidity: float = Field(
        default=0.5,
        ge=0,
        description="weight of the as-rigid-as-possible loss: squared strain between neighbouring nodes, in node "
        "spacings; lower it for objects that bend",
    )

    def resolve_nodes(self, is_clip: bool = False) -> ControlNodesField:
        """Return the section with the number of nodes and the learning rate filled in."""
        nodes, rate = CLIP_NODES if is_clip else JUMPING_NODES
        lr_means = rate if self.lr_means is None else self.lr_means
        return self.model_copy(update={"nodes": self.nodes or nodes, "lr_means": lr_means})


class FreeField(Section):
    """Gaussians with their own time, lifetime and velocity (FreeTimeGS, Wang et al. 2025)."""

    kind: Literal["free"] = Field(
        default="free",
        description="each moving Gaussian has its own time, lifetime and velocity (after FreeTimeGS); needs several "
        "cameras at each time",
    )


class Gaussians4DField(Section):
    """4D Gaussians: covariances over space and time (Yang et al. 2024)."""

    kind: Literal["gaussians_4d"] = Field(
        default="gaussians_4d",
        description="each moving Gaussian has a covariance over space and time (4D Gaussians, Yang "
        "et al.)",
    )
    frequencies: int = Field(
        default=0,
        ge=0,
        description="cosines in time of each spherical harmonic; 0: colours do not change; "
        "published: 2; ignored by colour networks",
    )
    lr_times: Positive = Field(
        default=0.01, description="learning rate of the mean times, in time steps of the capture"
    )
    lr_spans: Positive = Field(
        default=5e-3, description="learning rate of the logarithms of the scales along time"
    )
    time_grad_threshold: Positive | None = Field(
        default=None,
        description="mean gradient by the mean time, in clips, above which Gaussians are cloned or "
        "split; published: 5e-6; null: only the gradient of the 2D means counts",
    )
    predictor_width: int = Field(
        default=0,
        ge=0,
        description="neurons per layer of a network that deforms the moving Gaussians by view and "
        "time; 0: none; MEGA: 256",
    )


DeformField = HexplaneField | MlpField | ControlNodesField | FreeField | Gaussians4DField

TIMED_FIELDS = FreeField, Gaussians4DField
"""Fields of Gaussians that exist for a limited time."""


MIN_STATIC_STEPS = 1000
"""Steps of the static model before motion; short runs spend at most a third of their steps."""


class DynamicModel(SceneModel):
    """Canonical Gaussians and a deformation field over time (docs/concepts/motion.md)."""

    kind: Literal["dynamic"] = Field(
        default="dynamic",
        description="canonical Gaussians and a deformation field over time (`dyngs docs motion`)",
    )
    deform: Annotated[
        DeformField,
        Field(
            discriminator="kind", description="deformation field that moves the canonical Gaussians"
        ),
    ] = HexplaneField()
    pilot_runs: bool = Field(
        default=False,
        description="decide by short pilot runs, compared on held-out training views, whether to model motion "
        "(else the scene is trained as with the preset static; `dyngs docs motion`)",
    )
    motion_from: Fraction = Field(
        default=0.13,
        description="fraction of the run after which motion is trained; before, a static model is trained on all views "
        "(coarse stage of 4DGS), for at least 1000 steps or a third of the run",
    )
    static_decay: bool = Field(
        default=True,
        description="whether the learning rate of positions also decays while the model is static; "
        "4DGS: false",
    )
    motion_threshold: float = Field(
        default=0.04,
        ge=0,
        description="colour error (0 to 1) of the static model from which Gaussians are treated as moving",
    )
    select_moving: bool = Field(
        default=True,
        description="whether only Gaussians that the static model renders badly enter the field; "
        "false: all, and no rigid bodies are searched, as in 4DGS and Deformable-3DGS",
    )
    num_random_moving: int = Field(
        default=4000,
        ge=0,
        description="moving Gaussians added when motion starts: random ones, or, for Gaussians "
        "with a lifetime before fixed cameras, at most twice this many where images change",
    )
    time_window: Fraction = Field(
        default=1.0,
        description="fraction of the training views, around the middle of the clip, that motion is first trained on; "
        "1: all",
    )
    time_window_grows_from: Fraction = Field(
        default=0.0, description="fraction of the run after which the time window grows"
    )
    time_window_full_at: Fraction = Field(
        default=0.5, description="fraction of the run after which the time window covers all views"
    )
    freeze_below_px: float = Field(
        default=0.3,
        ge=0,
        description="Gaussians that move less than this many px in the nearest training view are frozen; 0: none",
    )
    motion_sparsity: float = Field(
        default=0.01,
        ge=0,
        description="weight of the mean displacement of the moving Gaussians, in scene extents",
    )

    @property
    def num_added_for_motion(self) -> int:
        if not isinstance(self.deform, TIMED_FIELDS):
            return self.num_random_moving
        return 2 * self.num_random_moving + COPIES_OF_MOVING

    def motion_start_step(self, steps: int) -> int:
        shortest = min(MIN_STATIC_STEPS, steps // 3)
        return min(max(1, round(self.motion_from * steps), shortest), steps)

    @property
    def bytes_per_moving_gaussian(self) -> int:
        # activations per Gaussian of space-time grids or networks
        if isinstance(self.deform, Gaussians4DField):
            return 200 + 20 * self.deform.predictor_width
        return 200 if isinstance(self.deform, (ControlNodesField, *TIMED_FIELDS)) else 2000
