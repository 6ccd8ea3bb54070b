"""Section ``train``: length, losses, checkpoints and logging of a run."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from dyngs.core.section import Fraction, Section, parse_digits

LOGGING_KEYS = (
    "save_minutes",
    "save_every",
    "eval_every",
    "eval_psnr",
    "log_every",
    "image_every",
    "loggers",
)
"""Keys of ``TrainConfig`` that do not change the result of a run."""


class TrainConfig(Section):
    """Length, losses, checkpoints and logging of a run."""

    steps: int = Field(
        default=7000, ge=1, description="number of training steps; all schedules scale with it"
    )
    minutes: float | None = Field(
        default=None,
        gt=0,
        description="maximum training time, minutes; lowers train.steps, and the image size if too "
        "few steps fit; null: no limit",
    )
    batch_size: int = Field(
        default=1,
        ge=1,
        description="number of views per step, whose gradients are averaged; split among the "
        "processes of torchrun, where 1 means one view per process",
    )
    initial_downscale: Annotated[Literal[1, 2, 4, 8, 16], BeforeValidator(parse_digits)] = Field(
        default=1,
        description="downscale factor of the training images at the start; 1: full resolution",
    )
    resolution_grows_from: Fraction = Field(
        default=0.4,
        description="fraction of the run after which the image resolution starts to grow",
    )
    resolution_full_at: Fraction = Field(
        default=0.7, description="fraction of the run after which images have full resolution"
    )
    ssim_weight: Fraction = Field(
        default=0.2, description="weight w of the SSIM loss, (1 - w) L1 + w (1 - SSIM)"
    )
    alpha_weight: float = Field(
        default=0.1,
        ge=0,
        description="weight of the alpha loss for images with alpha; 3DGS: 0; reduced to a fifth in "
        "the first 60 % of moving scenes, unless 5 % of the opaque pixels have the background colour",
    )
    priors: tuple[Literal["depth", "flow", "tracks", "motion_masks"], ...] = Field(
        default=("depth", "flow", "tracks", "motion_masks"),
        description="priors to use if the capture has them: depth maps, optical flow, 2D tracks, "
        "motion masks",
    )
    robust: Literal["never", "always"] = Field(
        default="never",
        description="whether to mask pixels that are inconsistent with the other views, such as "
        "passers-by; static scenes only",
    )
    exposure: Literal["never", "always"] = Field(
        default="never",
        description="whether to learn exposure and white balance of each training image as an "
        "affine colour transform",
    )
    losses: tuple[str, ...] = Field(
        default=(),
        description="names of the additional losses of a run from Python, see "
        "`dyngs docs python`; they are passed again to resume it",
    )
    remove_floaters: bool = Field(
        default=True,
        description="whether to remove floaters close to single cameras at the end of training; "
        "static scenes of 20 or more views",
    )
    sh_every: int = Field(
        default=1000,
        ge=1,
        description="steps of a 30,000-step run between increases of the active SH degree",
    )
    log_every: int = Field(default=10, ge=1, description="steps between entries of log.jsonl")
    save_minutes: float = Field(
        default=5.0,
        ge=0,
        description="minutes between checkpoints, more if saving takes over 5 % of the time; the "
        "newest two are kept; 0: only at the end",
    )
    save_every: int = Field(
        default=0, ge=0, description="steps between additional checkpoints; 0: none"
    )
    eval_every: int = Field(
        default=0, ge=0, description="steps between evaluations on the test split; 0: none"
    )
    eval_psnr: bool = Field(
        default=True,
        description="whether to measure the PSNR of test views at the end of training and, unless "
        "train.minutes is set, every train.save_minutes; takes at most 2 % of the training time",
    )
    image_every: int = Field(
        default=0,
        ge=0,
        description="steps between images of the first test view beside its photo, written to "
        "RUN/progress; 0: none",
    )
    loggers: tuple[Literal["tensorboard", "wandb", "rerun"], ...] = Field(
        default=(),
        description="programs that show scalars and images of the training; each needs its extra, "
        "such as pip install 'dyngs[wandb]'",
    )
