"""A kind of model that is not made of Gaussians: a grid of colours and densities, ray-marched in plain
torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.section import ModelSection
from dyngs.core.state import Role, State, StateTensor, add_prefix
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image
from dyngs.gaussians.optimizer import AdamState
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import ModelKind, StartContext
from dyngs.models.model import Model, RenderOutput, UpdateResult
from dyngs.models.renderable import DrawOptions, Renderable, Rendering, TimeStep
from dyngs.models.views import background_colour

if TYPE_CHECKING:
    from dyngs.models.kind import Restore, Start

CELLS, SAMPLES, HALF = 12, 24, 1.5


class ToyModel(ModelSection):
    """A grid around the origin."""

    kind: Literal["toy"] = Field(
        default="toy", description="a grid of colours and densities, for tests"
    )
    lr: float = Field(default=0.3, gt=0, description="learning rate")


@dataclass(frozen=True)
class ToyScene(Renderable):
    """A grid (1, 4, C, C, C) of logits: red, green, blue, density."""

    grid: Tensor
    options: DrawOptions = field(default_factory=DrawOptions)
    background: Tensor | None = None

    @property
    def times(self) -> tuple[float, ...]:
        return ()

    @property
    def bounds(self) -> Tensor:
        return torch.tensor([[-HALF] * 3, [HALF] * 3])

    @property
    def device(self) -> torch.device:
        return self.grid.device

    def state(self) -> State:
        return {"model.grid": StateTensor(self.grid.detach(), Role.SHARED)}

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        behind = self.background if background is None else background
        behind = torch.zeros(3) if behind is None else behind
        views = [
            self._view(pose, k, cameras)
            for pose, k in zip(cameras.cam_from_world, cameras.intrinsics, strict=True)
        ]
        rgb, through, depth = (torch.stack(x) for x in zip(*views, strict=True))
        wants_depth = (self.options if options is None else options).depth != "none"
        return Rendering(rgb + through[..., None] * behind, through, depth if wants_depth else None)

    def _view(
        self, pose: Tensor, intrinsics: Tensor, cameras: Cameras
    ) -> tuple[Tensor, Tensor, Tensor]:
        y, x = torch.meshgrid(
            torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5, indexing="ij"
        )
        local = torch.stack(
            [
                (x - intrinsics[0, 2]) / intrinsics[0, 0],
                (y - intrinsics[1, 2]) / intrinsics[1, 1],
                torch.ones_like(x),
            ],
            -1,
        )
        z = torch.linspace(1.5, 7.0, SAMPLES)
        points = (local[..., None, :] * z[:, None] - pose[:3, 3]) @ pose[:3, :3]
        found = torch.nn.functional.grid_sample(
            self.grid, points[None] / HALF, align_corners=False
        )[0]
        inside = (points.abs() < HALF).all(-1)
        alpha = torch.where(
            inside, 1 - torch.exp(-torch.nn.functional.softplus(found[3]) * (z[1] - z[0])), 0.0
        )
        left = torch.cumprod(1 - alpha, -1)
        weight = alpha * torch.cat([torch.ones_like(left[..., :1]), left[..., :-1]], -1)
        rgb = (weight * found[:3].sigmoid()).sum(-1).permute(1, 2, 0)
        return rgb, left[..., -1], (weight * z).sum(-1) / weight.sum(-1).clamp_min(1e-6)


class Toy(Model[ToyScene]):
    """A grid in training."""

    def __init__(self, run: StartContext, model: ToyModel) -> None:
        noise = 0.1 * torch.randn(1, 4, CELLS, CELLS, CELLS, generator=run.generator)
        self._grid = (noise - torch.tensor([0.0, 0, 0, 2]).view(1, 4, 1, 1, 1)).requires_grad_()
        self._lr = model.lr
        self._adam = AdamState.zero({"grid": self._grid})
        self._background = background_colour(run.background)

    @property
    def scene(self) -> ToyScene:
        return ToyScene(self._grid, background=self._background)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return [self._grid]

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        options = DrawOptions(depth="expected" if depth else "none")
        return RenderOutput(
            self.scene.render(image.cameras, image.time, options=options, background=background)
        )

    def regularizers(self) -> dict[str, Tensor]:
        return {"empty": 1e-4 * torch.nn.functional.softplus(self._grid[:, 3]).mean()}

    def update(self, step: int) -> UpdateResult:
        return UpdateResult(self._adam.step_("grid", self._grid, lr=self._lr, step=step))

    def state(self) -> State:
        return self.scene.state() | add_prefix("adam", self._adam.state())

    def restore(self, checkpoint: Checkpoint) -> None:
        self._grid = stored_grid(checkpoint).clone().requires_grad_()
        self._adam = AdamState.from_state(checkpoint.part("adam"), {"grid": self._grid})

    def place(self, device: torch.device) -> None:
        assert device.type == "cpu"


def stored_grid(checkpoint: Checkpoint) -> Tensor:
    return require_tensor("grid", checkpoint.tensors["model.grid"], (1, 4, CELLS, CELLS, CELLS))


def start(run: StartContext) -> Toy:
    model = run.config.model
    assert isinstance(model, ToyModel)
    return Toy(run, model)


def restore(model: ToyModel, checkpoint: Checkpoint) -> ToyScene:
    return ToyScene(
        stored_grid(checkpoint), background=background_colour(checkpoint.info.background)
    )


class ToyKind(ModelKind):
    """See the module."""

    def functions(self) -> tuple[Start, Restore]:
        return start, restore


TOY = ToyKind(ToyModel)
