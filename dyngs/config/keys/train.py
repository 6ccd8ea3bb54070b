"""Section ``train``: length, loss and logging of a run."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, field_validator

from dyngs.core.section import Fraction, Section, parse_digits


class TrainConfig(Section):
    """Length, loss and logging of a run."""

    steps: int = Field(
        default=7000, ge=1, description="optimisation steps; all schedules follow this number"
    )
    minutes: float | None = Field(
        default=None,
        gt=0,
        description="longest time of training on this machine, min; fewer than train.steps are done if need be, with "
        "schedules to match, in smaller images where too few fit, and a line at the end says what all would cost; 1 is "
        "a preview; null: no limit",
    )
    batch_size: int = Field(
        default=1,
        ge=1,
        description="views per step, whose gradients are averaged; processes that torchrun starts share them "
        "(`dyngs docs clusters`), and 1 means one for each process there",
    )
    initial_downscale: Annotated[Literal[1, 2, 4, 8, 16], BeforeValidator(parse_digits)] = Field(
        default=1,
        description="sides of the training images are divided by this at first; 1: full resolution",
    )
    resolution_grows_from: Fraction = Field(
        default=0.4,
        description="fraction of the run after which initial_downscale is halved for the first time",
    )
    resolution_full_at: Fraction = Field(
        default=0.7, description="fraction of the run after which images have their full resolution"
    )
    ssim_weight: Fraction = Field(
        default=0.2, description="weight w of 1 - SSIM; the loss is (1 - w) L1 + w (1 - SSIM)"
    )
    alpha_weight: float = Field(
        default=0.1,
        ge=0,
        description="weight of the mean error of opacity, where images have alpha, so that a scene is right on any "
        "background; a fifth of it in the first 60 % of a run on images with times, unless 5 % of the opaque pixels "
        "have the background's colour; published: 0",
    )
    priors: tuple[Literal["depth", "flow", "tracks", "motion_masks"], ...] = Field(
        default=("depth", "flow", "tracks", "motion_masks"),
        description="what is used in addition to images where the capture has it: depth maps, optical flow, 2D tracks, "
        "and masks that say what moves (`dyngs docs captures`)",
    )
    robust: Literal["never", "auto", "always"] = Field(
        default="never",
        description="leave out pixels that disagree with the other views (people who walk by); static scenes only; "
        "auto: where small runs beforehand say that it pays",
    )
    exposure: Literal["never", "auto", "always"] = Field(
        default="never",
        description="learn exposure and white balance of each training image (an affine colour, the mean one is the "
        "identity); auto: where small runs beforehand say that it pays",
    )
    remove_floaters: bool = Field(
        default=True,
        description="when training ends, remove Gaussians that hang close before a camera and show mostly there; still "
        "scenes of 20 views or more",
    )
    sh_every: int = Field(
        default=1000,
        ge=1,
        description="steps, of a 30,000-step run, after which one more degree of harmonics is trained each time",
    )
    log_every: int = Field(default=10, ge=1, description="steps between lines of log.jsonl")
    save_minutes: float = Field(
        default=5.0,
        ge=0,
        description="minutes of training between checkpoints, longer where saving takes more than a twentieth of that; "
        "the newest two are kept; 0: only the last",
    )
    save_every: int = Field(
        default=0, ge=0, description="steps between checkpoints, in addition; 0: none by steps"
    )
    eval_every: int = Field(
        default=0, ge=0, description="steps between evaluations; 0: only by `dyngs eval`"
    )
    tensorboard: bool = Field(
        default=False, description="also log to RUN/tensorboard (pip install dyngs[tensorboard])"
    )

    @field_validator("alpha_weight", mode="before")
    @classmethod
    def _read_unset(cls, value: object) -> object:
        """Return the default for null, which runs of earlier versions have."""
        return cls.model_fields["alpha_weight"].default if value is None else value
