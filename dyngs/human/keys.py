"""Section ``model`` of people, and of networks that predict them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from dyngs.core.section import Positive, SceneModel

NO_BODY = "has no body parameters, which model.kind=human needs; see `dyngs docs people`"


class _OnTemplate(SceneModel):
    """Keys that models of people share: a body template."""

    body: Path | None = Field(
        default=None, description="SMPL, SMPL-H or SMPL-X file; null: the free template"
    )
    uv: Path | None = Field(
        default=None, description=".obj with the texture coordinates of body; null: its own"
    )
    resolution: int = Field(
        default=128, ge=8, le=1024, description="texels per side of the template's texture atlas"
    )


class HumanModel(_OnTemplate):
    """A person: Gaussians on the texels of a body template, moved by its skeleton
    (docs/guides/people.md)."""

    kind: Literal["human"] = Field(
        default="human",
        description="one person: Gaussians on a body template, moved by its skeleton (`dyngs docs people`)",
    )
    fit: bool = Field(
        default=True,
        description="fit the template to the silhouettes before training, as `dyngs data fit` does; a capture without "
        "body parameters always is",
    )
    refine: bool = Field(
        default=True,
        description="learn corrections of poses, skeleton and skinning weights with the Gaussians",
    )
    light: bool = Field(
        default=True,
        description="learn light that is fixed in the world: colours depend on where the surface faces (with "
        "colour.kind=sh, model.refine=true)",
    )
    fill_unseen: bool = Field(
        default=True,
        description="after the last step, fill what the images hardly show from the other side of the body and from "
        "around it",
    )

    @property
    def bytes_per_moving_gaussian(self) -> int:
        """Bytes of its anchor, weights of joints, their gradients, and the Gaussian in a pose, where
        the body fit is refined."""
        return 2600

    def size_key(self, count: int) -> tuple[str, float, float]:
        return "model.resolution", self.resolution, 0.5


class HumanPredictorModel(_OnTemplate):
    """A network that predicts people from a few images, trained on others
    (docs/guides/people.md)."""

    kind: Literal["human_predictor"] = Field(
        default="human_predictor",
        description="a network that predicts people from a few images, after GHG (`dyngs docs people`)",
    )
    scaffold_heights: tuple[float, ...] = Field(
        default=(0.0, 0.02, 0.04),
        min_length=1,
        description="heights above the skin, m, at which copies of its surface carry one Gaussian per texel (the "
        "multi-scaffold of GHG)",
    )
    source_views: int = Field(
        default=3,
        ge=1,
        description="images of a person that it is predicted from, at most; every other training example has fewer",
    )
    lr: Positive = Field(default=2e-3, description="highest learning rate of AdamW (one cycle)")
