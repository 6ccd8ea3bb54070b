"""Registration by block matching in training: which images it looks at, and that runs keep their bytes."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest
import torch
from tiny_fields import busy_config, tiny_options

from dyngs.config import Config
from dyngs.deform.compared_views import ComparedViews
from dyngs.deform.scene import DynamicScene
from dyngs.deform.training import DynamicTraining
from dyngs.gaussians import Gaussians
from dyngs.kinds import assemble
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def config_of(moving: Path, tmp_path: Path, *, wanted: bool = True) -> Config:
    deform = tiny_options("control_nodes").model_copy(update={"lr_means": 1e-2, "block_matching": wanted})
    config = busy_config(moving, tmp_path / "run", "control_nodes", deform=deform)
    return config.model_copy(update={"train": config.train.model_copy(update={"hold_out_every": 5})})


def trained(config: Config, steps: int) -> Trainer:
    trainer = assemble(config)
    while trainer.done < steps:
        trainer.step()
    return trainer


def scene_and_views(trainer: Trainer) -> tuple[DynamicScene, ComparedViews]:
    views = cast(DynamicTraining, trainer.model.training).capture.matched
    assert views is not None
    return cast(DynamicScene, trainer.model.scene), views


def test_errors_are_those_of_images_that_are_trained_on(moving: Path, tmp_path: Path) -> None:
    """Within the times asked for."""
    trainer = trained(config_of(moving, tmp_path), 12)
    scene, views = scene_and_views(trainer)
    asked: list[float] = []

    def at(time: float) -> Gaussians:
        asked.append(time)
        return scene.deformed_at(time)[0]

    error = views.error(at, (0.2, 0.7))
    shown = [
        i for i, time in enumerate(trainer.images.times) if 0.2 <= (time or 0.0) <= 0.7 and i not in trainer.held_out
    ]
    assert asked == [trainer.images.times[i] for i in shown]
    assert set(shown) < set(range(len(trainer.images))) - trainer.held_out
    wanted = []
    for image in (trainer.images[i] for i in shown):
        with torch.no_grad():
            drawn = scene.render(image.cameras, image.time, options=views.options, background=views.background)
        wanted.append((drawn.rgb[0] - image.composite(views.background)).square().mean())
    assert error == pytest.approx(float(torch.stack(wanted).mean()), rel=1e-5)
    assert views.error(at, (0.501, 0.502)) == 0.0


def test_a_registration_never_raises_the_error(moving: Path, tmp_path: Path) -> None:
    trainer = trained(config_of(moving, tmp_path), 16)
    scene, views = scene_and_views(trainer)
    training = cast(DynamicTraining, trainer.model.training)
    before = views.error(lambda time: scene.deformed_at(time)[0], (0.0, 1.0))
    after = training._registered(scene, 16)
    assert views.error(lambda time: after.deformed_at(time)[0], (0.0, 1.0)) <= before


def test_a_run_goes_on_with_the_same_bytes(moving: Path, tmp_path: Path) -> None:
    config = config_of(moving, tmp_path)
    whole, first, second = trained(config, 24), trained(config, 15), assemble(config, restored=True)
    second.restore(first.checkpoint())
    while second.done < 24:
        second.step()
    resumed = second.checkpoint().tensors
    for name, x in whole.checkpoint().tensors.items():
        assert torch.equal(x, resumed[name]), name


def test_it_is_done_only_where_it_is_wanted(moving: Path, tmp_path: Path) -> None:
    with_it, without = (assemble(config_of(moving, tmp_path, wanted=x)) for x in (True, False))
    assert cast(DynamicTraining, with_it.training).schedule.matches
    assert not cast(DynamicTraining, without.training).schedule.matches
