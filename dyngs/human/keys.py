"""Configuration of avatars (``model.kind=human``) and of the network that predicts them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dyngs.core.section import Positive, SceneModel

NO_BODY = "has no body parameters, which model.kind=human needs; see `dyngs docs people`"


class _OnTemplate(SceneModel):
    """Keys of all models that place Gaussians on a body template."""

    body: Path | None = Field(
        default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template"
    )
    uv: Path | None = Field(
        default=None, description=".obj with the UV map of model.body; null: that of the body file"
    )
    resolution: int = Field(
        default=128, ge=8, le=1024, description="texels per side of the template's UV map"
    )


class HumanModel(_OnTemplate):
    """Avatar: one Gaussian per texel of a body template, posed by linear blend skinning
    (`dyngs docs people`)."""

    kind: Literal["human"] = Field(
        default="human",
        description="avatar of one person: Gaussians on a body template, posed by its skeleton "
        "(`dyngs docs people`)",
    )
    fit: bool = Field(
        default=True,
        description="fit the template to the silhouettes before training, as `dyngs data fit` "
        "does; always done for a capture without body parameters",
    )
    refine: bool = Field(
        default=True,
        description="optimise poses, skeleton and skinning weights together with the Gaussians",
    )
    light: bool = Field(
        default=True,
        description="learn light that is fixed in the world, so that colours depend on the "
        "surface normal (needs colour.kind=sh and model.refine=true)",
    )
    fill_unseen: bool = Field(
        default=True,
        description="after the last step, fill regions that few images show from the mirrored "
        "side of the body and from neighbouring texels",
    )

    @property
    def bytes_per_moving_gaussian(self) -> int:
        """Memory per Gaussian while ``refine`` is on: anchor, skinning weights, gradients and posed
        Gaussian."""
        return 2600

    def size_key(self, count: int) -> tuple[str, float, float]:
        return "model.resolution", self.resolution, 0.5


class HumanPredictorModel(_OnTemplate):
    """Network that predicts avatars from a few images, trained on other people
    (`dyngs docs people`)."""

    kind: Literal["human_predictor"] = Field(
        default="human_predictor",
        description="network that predicts avatars from a few images, after GHG ("
        "`dyngs docs people`)",
    )
    scaffold_heights: tuple[float, ...] = Field(
        default=(0.0, 0.02, 0.04),
        min_length=1,
        description="heights of the scaffolds above the skin, m; each has one Gaussian per texel "
        "(multi-scaffold of GHG)",
    )
    source_views: int = Field(
        default=3,
        ge=1,
        description="largest number of input images per person; every other training example has "
        "fewer",
    )
    unseen_colours: Literal["mixture", "inpainted"] = Field(
        default="mixture",
        description="colours of texels that no image shows; mixture: of the mean person, texels "
        "nearby and the mirrored side, inpainted: by gated convolutions on the UV map (GHG)",
    )
    lr: Positive = Field(
        default=1e-3, description="peak learning rate of AdamW (one-cycle schedule)"
    )
