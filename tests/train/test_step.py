"""One step: any model that keeps the protocol is trained, on the right background, and bad gradients do no harm."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, RandomInit, RunConfig, StaticModel, TrainConfig
from dyngs.data.loader import Picture
from dyngs.data.synthetic import StillOptions, write_still_capture
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.train.assemble import assemble
from dyngs.train.step import Trainer


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=2, num_test=1, samples=1))
    return folder


def _trainer(capture: Path, **data: object) -> Trainer:
    return assemble(
        Config(
            data=DataConfig(root=capture, **data),  # type: ignore[arg-type]
            model=StaticModel(sh_degree=1),
            init=RandomInit(num_random=50),
            train=TrainConfig(steps=100),
            run=RunConfig(threads=1),
        )
    )


class _Lifted:
    """A model of another kind: all Gaussians are drawn a little higher than they are stored."""

    def __init__(self) -> None:
        self.steps: list[int] = []

    def gaussians_at(self, parameters: Gaussians, batch: Picture) -> Gaussians:
        return parameters.replace(means=parameters.means + torch.tensor([0.0, 0.0, 0.1]))

    def after_step(self, parameters: Gaussians, step: int, *, edited: bool) -> None:
        self.steps.append(step)

    def state(self) -> dict[str, Tensor]:
        return {"steps": torch.tensor(self.steps)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.steps = state["steps"].tolist()


def test_a_model_of_another_kind_is_trained(capture: Path) -> None:
    trainer = _trainer(capture)
    trainer.model = _Lifted()
    before = trainer.optimizer.parameters.means.detach().clone()
    losses = [trainer.step().loss for _ in range(30)]
    assert trainer.model.steps == list(range(1, 31))
    assert sum(losses[-4:]) < sum(losses[:4])
    assert not torch.equal(trainer.optimizer.parameters.means, before)
    other = _trainer(capture)
    other.model = _Lifted()
    other.restore(trainer.checkpoint())
    assert other.step().loss == trainer.step().loss


@pytest.mark.parametrize(("choice", "value"), [("white", 1.0), ("black", 0.0), ("auto", 1.0)])
def test_truth_and_render_share_the_background(capture: Path, choice: str, value: float) -> None:
    report = _trainer(capture, background=choice).step()
    assert report.picture.alpha is not None
    empty = report.picture.alpha == 0
    assert empty.any()
    assert (report.truth[empty] == value).all()


def test_a_random_background_is_new_in_each_step(capture: Path) -> None:
    trainer = _trainer(capture, background="random")
    colours = []
    for _ in range(3):
        report = trainer.step()
        assert report.picture.alpha is not None
        shown = report.truth[report.picture.alpha == 0].unique(dim=0)
        assert len(shown) == 1
        colours.append(tuple(shown[0].tolist()))
    assert len(set(colours)) == 3


def test_a_checkpoint_of_another_model_is_refused(capture: Path) -> None:
    trainer = _trainer(capture)
    checkpoint = trainer.checkpoint()
    del checkpoint.tensors["sampler.order"]
    with pytest.raises(DyngsError, match="lacks 'order'"):
        trainer.restore(checkpoint)
