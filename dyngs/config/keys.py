"""The typed configuration of a run: frozen pydantic models, composed into ``Config``.

Loading (YAML preset + ``a.b=c`` overrides + "did you mean") lives in ``dyngs.config.io``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from dyngs.conventions import RasterizeMode
from dyngs.files.containment import MAX_MEGAPIXELS

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
CutOff = Annotated[float, Field(ge=1e-6, le=0.5)]


class Section(BaseModel):
    """Base of every section: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DataConfig(Section):
    """Where the pictures are and how they are read."""

    root: Path = Field(description="capture folder")
    format: Literal[
        "auto",
        "body_json",
        "zju_mocap",
        "people_snapshot",
        "neuman",
        "blender",
        "nerfstudio",
        "colmap",
        "nerfies",
        "llff",
        "camera_folders",
    ] = "auto"
    frames: str | None = Field(default=None, description="start:stop:step over the capture's times, as Python slices")
    downscale: float = Field(default=1.0, ge=1.0, description="divide width and height by this")
    longest_side: int | None = Field(
        default=None, ge=1, description="shrink so that the longer side has at most this many px"
    )
    test_every: int = Field(default=8, ge=0, description="every n-th picture by name is held out; 0 = none")
    background: Literal["auto", "white", "black", "random"] = Field(
        default="auto", description="auto: white where the pictures have alpha, black otherwise"
    )
    cache_mb: float = Field(default=4096, ge=0, description="memory for decoded pictures")
    frame_cache_mb: float = Field(default=4096, ge=0, description="disk for the frames of videos of all captures")
    follow_links: bool = Field(default=False, description="files of the capture may lie outside its folder")
    max_megapixels: Positive = Field(
        default=MAX_MEGAPIXELS, description="larger pictures and videos are refused, not decoded"
    )


class PointsInit(Section):
    """Start from the capture's sparse points, else from triangulated ones, else from random ones."""

    kind: Literal["auto", "points"] = "auto"
    triangulate: int = Field(
        default=24, ge=0, description="pictures of one moment to triangulate points from where the capture has none"
    )
    num_random: int = Field(default=100_000, ge=1, description="used where there are no points at all")
    half_extent: Positive = 1.3


class RandomInit(Section):
    """Start from uniformly random points in a cube around the origin (Blender scenes of 3DGS)."""

    kind: Literal["random"] = "random"
    num_random: int = Field(default=100_000, ge=1)
    half_extent: Positive = Field(default=1.3, description="half the cube's side, world units")


class SceneModel(Section):
    """What all models have in common: how Gaussians are coloured and drawn."""

    sh_degree: int = Field(default=3, ge=0, le=4)
    rasterize_mode: RasterizeMode = RasterizeMode.CLASSIC
    eps2d: float = Field(
        default=0.3, ge=0, description="2D low-pass variance, px^2 (Mip-Splatting: 0.1 with antialiased)"
    )
    filter_3d: bool = Field(default=False, description="Mip-Splatting's 3D smoothing filter")
    near: Positive = Field(default=0.2, description="near plane, world units")
    alpha_min: CutOff = Field(
        default=1 / 255, description="a pixel skips Gaussians that cover less of it; 1/255 in 3DGS"
    )
    transmittance_min: CutOff = Field(
        default=1e-4, description="a pixel is done when less of what lies behind shines through"
    )


class StaticModel(SceneModel):
    """3D Gaussian splatting, Mip-Splatting's filters as options."""

    kind: Literal["static"] = "static"


class FieldSection(Section):
    """What all deformation fields have in common: which attributes move."""

    move_rotations: bool = True
    move_scales: bool = True
    move_opacities: bool = Field(default=False, description="things may appear and vanish")
    move_colors: bool = Field(default=False, description="the base colour may change over time")


class HexplaneField(FieldSection):
    """Planes over pairs of space and time axes and a small decoder (4DGS, Wu et al. 2024)."""

    kind: Literal["hexplane"] = "hexplane"
    channels: int = Field(default=32, ge=1, description="features per plane and level")
    resolution: int = Field(default=64, ge=2, description="of the first level along x, y and z")
    levels: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(1, 2), min_length=1, description="multipliers")
    time_resolution: int = Field(default=0, ge=0, description="0 = half the number of training times")
    width: int = Field(default=64, ge=1, description="of the decoder")
    depth: int = Field(default=1, ge=1, description="linear layers before the heads")
    lr_planes: Positive = Field(default=1.6e-3, description="times the scene extent")
    lr_decoder: Positive = Field(default=1.6e-4, description="times the scene extent")
    lr_decay: Fraction = Field(default=0.01, description="last over first rate")
    space_smoothness: float = Field(default=1e-4, ge=0)
    time_smoothness: float = Field(default=0.01, ge=0)
    time_sparsity: float = Field(default=1e-4, ge=0, description="weight of mean |1 - plane| on the planes with time")


class MlpField(FieldSection):
    """A multilayer perceptron on encoded position and time (Deformable-3DGS, Yang et al. 2024)."""

    kind: Literal["mlp"] = "mlp"
    depth: int = Field(default=8, ge=2, description="hidden layers")
    width: int = Field(default=256, ge=1)
    space_frequencies: int = Field(default=10, ge=0, le=16)
    time_frequencies: int = Field(default=6, ge=0, le=16)
    lr: Positive = 8e-4
    lr_decay: Fraction = Field(default=0.002, description="last over first rate")


class SkeletonField(FieldSection):
    """Control nodes that move along splines, which Gaussians around them follow (after SC-GS, Huang et al. 2024)."""

    kind: Literal["skeleton"] = "skeleton"
    nodes: int = Field(default=512, ge=1)
    pieces: int = Field(default=0, ge=0, description="of the splines; 0 = 0.3 times the number of training times")
    lr_means: Positive = Field(default=6e-4, description="times the scene extent")
    lr_quats: Positive = 6e-3
    lr_scales: Positive = 1e-3
    lr_opacities: Positive = 1e-2
    lr_colors: Positive = 2e-3
    lr_decay: Fraction = Field(default=0.2, description="last over first rate")
    rigidity: float = Field(default=0.5, ge=0, description="weight of neighbours' strain, squared node spacings")
    smoothness: float = Field(default=0.01, ge=0, description="weight of the acceleration")


class TrajectoryField(FieldSection):
    """A polynomial and a Fourier series per Gaussian, no network: for small motion and long clips."""

    kind: Literal["trajectory"] = "trajectory"
    polynomial: int = Field(default=3, ge=0, le=8, description="highest power of time")
    fourier: int = Field(default=4, ge=0, le=32, description="number of frequencies")
    lr_means: Positive = Field(default=1.6e-4, description="of the coefficients, times the scene extent")
    lr_quats: Positive = 1e-3
    lr_decay: Fraction = Field(default=0.01, description="last over first rate")


DeformField = HexplaneField | MlpField | TrajectoryField | SkeletonField


class DynamicModel(SceneModel):
    """Canonical Gaussians and a deformation field over time. Step numbers follow ``train.steps``."""

    kind: Literal["dynamic"] = "dynamic"
    deform: Annotated[DeformField, Field(discriminator="kind")] = HexplaneField()
    coarse: Fraction = Field(default=0.13, description="share of the run that trains without motion, on all views")
    moving_error: float = Field(
        default=0.04, ge=0, description="things may move only where the still model's colour error is larger"
    )
    seeds: int = Field(default=4000, ge=0, description="random Gaussians added where motion begins")
    first_views: Fraction = Field(
        default=1.0, description="share of the views, around the middle, to begin motion with"
    )
    first_views_until: Fraction = Field(default=0.0, description="share of the run from which more views are added")
    all_views_at: Fraction = Field(default=0.5, description="share of the run from which all times are trained on")
    still_below: float = Field(default=0.3, ge=0, description="px in the nearest training view; 0 = all may move")
    motion_sparsity: float = Field(default=0.01, ge=0, description="weight of the mean motion, in scene extents")
    time_jitter: float = Field(default=0.0, ge=0, description="of the step between times, annealed; 0.1 suits videos")


class HumanModel(SceneModel):
    """A person: Gaussians on the texels of a body template, moved by its skeleton (docs/human.md)."""

    kind: Literal["human"] = "human"
    body: Path | None = Field(default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template")
    uv: Path | None = Field(default=None, description=".obj with the texture coordinates of the body")
    resolution: int = Field(default=128, ge=8, le=1024, description="texels per side of the atlas")
    heights: tuple[float, ...] = Field(
        default=(0.0, 0.02), min_length=1, description="of the scaffolds above the skin, m"
    )
    carve: Fraction = Field(
        default=0.9, description="share of the silhouettes that a scaffold above the skin must lie inside of"
    )
    refine: bool = Field(default=True, description="learn poses, skeleton and skinning weights together with the rest")
    refine_from: Fraction = Field(default=0.1, description="share of the run after which that begins")
    lr_poses: Positive = Field(default=1e-3, description="of the poses of single frames, rad")
    lr_trans: Positive = Field(default=5e-4, description="of the places of single frames, m")
    lr_turns: Positive = Field(default=1e-3, description="of what is added to the poses of all frames, rad")
    lr_joints: Positive = Field(default=5e-4, description="of the joints at rest, m")
    lr_log_scale: Positive = 2e-4
    lr_weights: Positive = Field(default=5e-3, description="of the logarithms of skinning weights")
    lr_decay: Fraction = Field(default=0.1, description="last over first rate of all these")
    pose_offsets: bool = Field(default=False, description="learn offsets that depend on the turns of nearby joints")
    lr_pose_offsets: Positive = Field(default=1e-4, description="m per unit of a rotation matrix")
    pose_weight: float = Field(default=1e-4, ge=0, description="of the squared corrections of the fit")
    weights_weight: float = Field(default=1e-3, ge=0, description="of the squared corrections of skinning weights")
    offset_weight: float = Field(default=2e-4, ge=0, description="of squared distances from the scaffold, cm")
    scale_weight: float = Field(default=1e-2, ge=0, description="of Gaussians that outgrow their texel")
    rigidity: float = Field(default=1e-2, ge=0, description="of changed distances to five neighbours, cm")
    smoothness: float = Field(default=1e-3, ge=0, description="of what the offsets of five neighbours differ, cm")


class HumanNetModel(SceneModel):
    """A network that predicts people from a few pictures, trained on others (docs/people_network.md)."""

    kind: Literal["human_net"] = "human_net"
    body: Path | None = Field(default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template")
    uv: Path | None = Field(default=None, description=".obj with the texture coordinates of the body")
    resolution: int = Field(default=128, ge=8, le=1024, description="texels per side of the atlas")
    heights: tuple[float, ...] = Field(
        default=(0.0, 0.02, 0.04), min_length=1, description="of the scaffolds above the skin, m"
    )
    carve: Fraction = Field(
        default=0.9, description="share of the silhouettes that a scaffold above the skin must lie inside of"
    )
    views: int = Field(default=3, ge=1, description="pictures of a person that are predicted from")
    inputs: int = Field(default=6, ge=1, description="choices of such pictures per person, which are cached")
    targets: int = Field(default=2, ge=1, description="pictures of one moment to compare with per step")
    widths: tuple[Annotated[int, Field(ge=8)], ...] = Field(
        default=(24, 32, 48, 64), min_length=1, description="channels at 1/2, 1/4, .. of the resolution"
    )
    lr: Positive = Field(default=2e-3, description="highest rate")
    warm_up: Fraction = Field(default=0.05, description="share of the run in which it is reached; then it falls to 0")
    weight_decay: float = Field(default=1e-5, ge=0)
    clip: Positive = Field(default=1.0, description="longest gradient")


class ColourSection(Section):
    """What all kinds of colour have in common."""

    opacity_entropy: float = Field(
        default=0.0, ge=0, description="weight of mean -o ln o, which removes what is faint; MEGA: 5e-4"
    )


class ShColour(ColourSection):
    """Spherical harmonics of degree ``model.sh_degree`` for every Gaussian."""

    kind: Literal["sh"] = "sh"


class DcacColour(ColourSection):
    """Three base values per Gaussian and one small network for all (MEGA, Zhang et al. 2024); no harmonics."""

    kind: Literal["dcac"] = "dcac"
    width: int = Field(default=32, ge=1, description="of the network's hidden layers; MEGA: 64")
    depth: int = Field(default=2, ge=1, le=8, description="hidden layers")
    normals: bool = Field(default=True, description="the network also sees how Gaussians lie, and what they mirror")
    lr: Positive = Field(default=0.01, description="of the network; divided by 3 after 1/6, 1/2 and 5/6 of the run")
    warm_up: int = Field(default=100, ge=1, description="steps in which that rate is reached")


class AutoColour(ColourSection):
    """Harmonics only for the Gaussians whose dependence on the view pays on held-out training views."""

    kind: Literal["auto"] = "auto"
    measure_at: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.6, description="share of the run after which that is measured; until then every 8th view is held out"
    )
    tolerance: float = Field(default=0.05, ge=0, description="dB that may be given away")


class DefaultStrategy(Section):
    """Clone, split and prune by the gradient of the 2D means (3DGS, AbsGS as an option).

    Step numbers are those of a 30,000-step run and are scaled with ``train.steps``.
    """

    kind: Literal["default"] = "default"
    absgrad: bool = False
    grad_threshold: Positive = Field(
        default=2e-4, description="mean over views, NDC units; shorter runs than 30,000 go lower (8e-4 suits absgrad)"
    )
    dense_fraction: Positive = Field(
        default=0.01, description="of the extent: smaller ones are cloned, larger ones split"
    )
    start: int = 500
    stop: int = 15_000
    every: int = Field(default=100, ge=1, description="not scaled")
    prune_opacity: Fraction = 0.005
    prune_scale: Positive = Field(default=0.1, description="of the extent, after the first opacity reset")
    reset_every: int = Field(default=3000, ge=1)
    max_gaussians: int = Field(default=3_000_000, ge=1)


class McmcStrategy(Section):
    """3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): a cap, relocation, noise."""

    kind: Literal["mcmc"] = "mcmc"
    max_gaussians: int = Field(default=300_000, ge=1)
    start: int = 500
    stop: int = 25_000
    every: int = Field(default=100, ge=1)
    growth: Positive = 0.05
    min_opacity: Fraction = 0.005
    noise: float = Field(default=5e5, ge=0)
    opacity_reg: float = Field(default=0.01, ge=0)
    scale_reg: float = Field(default=0.01, ge=0)
    init_opacity: Fraction = 0.5
    init_scale: Positive = 0.1


class OptimConfig(Section):
    """Adam and its learning rates (methods: 3DGS)."""

    lr_means: Positive = Field(default=1.6e-4, description="times the scene extent")
    lr_means_final: Positive = 1.6e-6
    lr_sh_dc: Positive = 2.5e-3
    lr_sh_rest: Positive = 1.25e-4
    lr_opacities: Positive = 0.05
    lr_scales: Positive = 5e-3
    lr_quats: Positive = 1e-3
    eps: Positive = 1e-15
    sparse: bool = Field(default=False, description="skip Gaussians that received no gradient in the step")


class TrainConfig(Section):
    """Length, loss and logging of a run."""

    steps: int = Field(default=7000, ge=1)
    coarsest: Literal[1, 2, 4, 8, 16] = Field(default=1, description="divide the sides of the first pictures by this")
    sharpen_from: Fraction = Field(default=0.4, description="share of the run after which that is halved first")
    sharpen_to: Fraction = Field(default=0.7, description="share of the run after which it is halved last")
    ssim_weight: Fraction = 0.2
    alpha_weight: float = Field(default=0.0, ge=0, description="of the error of opacity where pictures have alpha")
    sh_every: int = Field(default=1000, ge=1, description="steps (of 30,000) between SH degree increments")
    log_every: int = Field(default=10, ge=1)
    save_every: int = Field(default=0, ge=0, description="steps between checkpoints; 0 = only the last")
    eval_every: int = Field(
        default=0, ge=0, description="steps between evaluations; 0 = only when `dyngs eval` is called"
    )
    tensorboard: bool = False


class CompactConfig(Section):
    """A last stage with fewer Gaussians, after ``train.steps`` (docs/compact.md). Off where nothing is asked for."""

    prune: float = Field(default=0.0, ge=0, lt=1, description="share of the Gaussians to remove; 0 = none")
    score: Literal["variation", "sensitivity", "contribution", "temporal"] = Field(
        default="sensitivity", description="what a Gaussian is worth; the lowest go"
    )
    max_loss: float = Field(
        default=10.0, ge=0, description="dB on training pictures, before fine-tuning; above it fewer are removed"
    )
    masks: int = Field(default=0, ge=0, description="key times of the masks of what is seen; 0 or 1 = no masks")
    mask_below: float = Field(default=0.0, ge=0, description="px of a Gaussian in all views that count as not seen")
    steps: int = Field(default=2000, ge=1, description="of fine-tuning")
    rewind: float = Field(
        default=0.3, ge=0, le=1, description="share of training whose learning rates fine-tuning goes back to"
    )

    @property
    def is_wanted(self) -> bool:
        """Anything is to be done."""
        return self.prune > 0 or self.masks > 1


class BudgetConfig(Section):
    """Limits that a run keeps (docs/budget.md); null: none."""

    max_gaussians: int | None = Field(default=None, ge=1, description="no more than so many at the end")
    max_mb: float | None = Field(
        default=None, gt=0, description="1e6 bytes of the file `small/scene.dyngs`, which is then written"
    )
    max_minutes: float | None = Field(
        default=None, gt=0, description="of training on this machine; fewer than `train.steps` are done if need be"
    )
    min_fps: float | None = Field(
        default=None, gt=0, description="training views drawn per second on this machine, by fewer Gaussians if need be"
    )


class RunConfig(Section):
    """Where the run goes and how it is executed."""

    name: str = "static"
    dir: Path | None = Field(default=None, description="run folder; default runs/NAME")
    seed: int = Field(default=42, ge=0, lt=2**63)
    threads: int = Field(default=0, ge=0, le=1024, description="0 = all cores")


class Config(Section):
    """Everything that decides a run."""

    data: DataConfig
    model: Annotated[StaticModel | DynamicModel | HumanModel | HumanNetModel, Field(discriminator="kind")] = (
        StaticModel()
    )
    init: Annotated[PointsInit | RandomInit, Field(discriminator="kind")] = PointsInit()
    colour: Annotated[ShColour | DcacColour | AutoColour, Field(discriminator="kind")] = ShColour()
    strategy: Annotated[DefaultStrategy | McmcStrategy, Field(discriminator="kind")] = DefaultStrategy()
    optim: OptimConfig = OptimConfig()
    train: TrainConfig = TrainConfig()
    compact: CompactConfig = CompactConfig()
    budget: BudgetConfig = BudgetConfig()
    run: RunConfig = RunConfig()

    @property
    def total_steps(self) -> int:
        """Of training and of the last stage, if there is one."""
        compacts = self.compact.is_wanted and not isinstance(self.model, HumanNetModel)
        return self.train.steps + (self.compact.steps if compacts else 0)
