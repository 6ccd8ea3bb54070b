"""The last stage of a run: exact, repeatable, the same as pruning the finished run, and drawn with
masks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_fields import ALL_KINDS, busy_config, cloud, tiny_setup
from torch import Tensor

from dyngs.api.train import train
from dyngs.compress.stage import build_pruning_edit, visible_between_times
from dyngs.config import (
    Config,
    DataConfig,
    McmcStrategy,
    PruneConfig,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.deform.free import FreeInitialization, FreePrimitives
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.keys import FreeField
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.densify import Densifier
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import checkpoint_paths, load_checkpoint, load_run
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")
STAGE = PruneConfig(fraction=0.5, steps=6, mask_times=3)


def moving_config(
    capture: Path, run_dir: Path, kind: str = "control_nodes", stage: PruneConfig = STAGE
) -> Config:
    return busy_config(capture, run_dir, kind).model_copy(update={"prune": stage})


def still_config(
    capture: Path, run_dir: Path, stage: PruneConfig = STAGE, **changes: object
) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=1, filter_3d=True),
        init=RandomInit(num_random=60),
        train=TrainConfig(steps=8, log_every=1),
        prune=stage,
        run=RunConfig(dir=run_dir, threads=1),
    ).model_copy(update=changes)


def final_bytes(run_dir: Path) -> bytes:
    return checkpoint_paths(run_dir)[-1].read_bytes()


def trained(config: Config) -> Trainer:
    """A trainer at the end of ``train.steps``."""
    trainer = build_trainer(config)
    while trainer.done < config.train.steps:
        trainer.step()
    return trainer


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_moving_run_goes_on_with_half_of_it_and_resumes_exactly(
    kind: str, moving: Path, tmp_path: Path
) -> None:
    """From the checkpoint before the stage, and from one in its middle."""
    config = moving_config(moving, tmp_path / "run", kind)
    config = config.model_copy(update={"train": config.train.model_copy(update={"save_every": 27})})
    folder = train(config)
    run = load_run(folder)
    paths = checkpoint_paths(folder)
    assert [p.stem for p in paths] == ["step_0000027", "step_0000030"]
    wanted = final_bytes(folder)
    paths[-1].unlink()
    assert final_bytes(train(load_resolved(folder), resume_from=folder)) == wanted
    if run.scene.is_static:
        return
    assert run.scene.masks is not None
    assert run.scene.masks.count == len(run.scene)
    assert len(run.scene.masks.times) == 3
    assert len(run.scene.at(0.4)) == len(run.scene.masks.active(0)) <= len(run.scene)
    assert len(run.scene.part("moving").at(0.4)) == len(run.scene.rows)


def test_a_still_run_has_no_masks_and_resumes_exactly(still: Path, tmp_path: Path) -> None:
    wanted = final_bytes(train(still_config(still, tmp_path / "whole")))
    config = still_config(still, tmp_path / "parts")
    folder = train(
        config.model_copy(update={"train": config.train.model_copy(update={"save_every": 11})})
    )
    assert load_run(folder).step == 14
    checkpoint_paths(folder)[-1].unlink()
    assert load_run(folder).step == 11
    train(load_resolved(folder), resume_from=folder)
    assert final_bytes(folder) == wanted
    assert not [
        name for name in load_checkpoint(checkpoint_paths(folder)[-1]).tensors if "masks" in name
    ]


def test_mcmc_stands_still_in_the_stage(still: Path, tmp_path: Path) -> None:
    """No noise, no relocation: the number stays, and the state of the strategy is gone."""
    strategy = McmcStrategy(start=1, stop=30_000, every=3, max_gaussians=90)
    trainer = trained(still_config(still, tmp_path, strategy=strategy))
    before = len(trainer.model.scene.gaussians)
    trainer.apply(build_pruning_edit(trainer))
    assert isinstance(trainer.model.densifier, Densifier)
    for _ in range(4):
        trainer.step()
    assert len(trainer.model.scene.gaussians) == before - before // 2


@pytest.mark.parametrize("score", ["sensitivity", "contribution", "temporal", "variation"])
def test_every_score_keeps_as_many(score: str, moving: Path, tmp_path: Path) -> None:
    stage = STAGE.model_copy(update={"score": score})
    trainer = trained(moving_config(moving, tmp_path, "control_nodes", stage))
    before = trainer.model.scene.gaussians.detach()
    trainer.apply(build_pruning_edit(trainer))
    after = trainer.model.scene.gaussians
    assert len(after) == len(before) - len(before) // 2
    assert _all_rows_of(after.means, before.means)
    assert isinstance(trainer.model.scene, DynamicScene)
    assert trainer.num_moving <= len(after)


def _all_rows_of(some: Tensor, everything: Tensor) -> bool:
    return bool((some[:, None] == everything[None]).all(-1).any(1).all())


def test_masks_are_trained_with(moving: Path, tmp_path: Path) -> None:
    """Gaussians that no key time observes are not rendered and receive no gradient."""
    trainer = trained(moving_config(moving, tmp_path, "control_nodes"))
    trainer.apply(build_pruning_edit(trainer))
    scene = trainer.model.scene
    assert scene.masks is not None
    image = trainer.images[3]
    drawn = trainer.model.training.time_step(scene, image, trainer.done + 1)
    active = scene.masks.active(scene.masks.interval(image.time or 0.0))
    assert len(drawn.gaussians) == len(active)
    drawn.gaussians.means.sum().backward()
    grad = trainer.model.scene.gaussians.means.grad
    assert grad is not None
    assert torch.equal(torch.nonzero(grad.any(1))[:, 0], active)


@pytest.mark.parametrize("is_kept", [True, False])
def test_masks_as_published_drop_what_no_key_time_shows(
    is_kept: bool, moving: Path, tmp_path: Path
) -> None:
    """4D Gaussians that last for a moment between two key times."""
    stage = PruneConfig(mask_times=3, mask_between=is_kept)
    trainer = trained(moving_config(moving, tmp_path, "gaussians_4d", stage))
    scene = trainer.model.scene
    assert isinstance(scene, DynamicScene)
    assert isinstance(scene.field, Gaussians4D)
    own = scene.field.parameters
    left = scene.gaussians.quats.detach()[scene.moving]
    own["right_quats"].data.copy_(left * left.new_tensor([1.0, -1.0, -1.0, -1.0]))
    own["times"].data.fill_(scene.times[3])
    own["log_spans"].data.fill_(-7.0)
    masks = build_pruning_edit(trainer).masks
    assert masks is not None
    assert bool(masks.seen[0, scene.moving].any()) is is_kept


def test_what_is_there_for_a_while_is_masked_only_while_it_is_not() -> None:
    """Between key times, too: three of ten training times are key times, and none of the Gaussians
    is there at them."""
    centers = torch.tensor([2, 3, 6, 7]) / 9
    spans = torch.full((4,), 0.03)
    start = FreeInitialization(torch.zeros(0), (), centers, spans, torch.zeros(4, 3))
    field = FreePrimitives(FreeField(), tiny_setup(4), torch.Generator()).with_initialization(start)
    times = tuple(k / 9 for k in range(10))
    scene = DynamicScene(
        gaussians=cloud(5), training_times=times, field=field, moving=torch.arange(4)
    )
    keys = (times[0], times[5], times[9])
    masks = VisibilityMasks.pack(keys, visible_between_times(scene, keys, 1 / 255))
    assert masks.seen.sum(0).tolist() == [1, 1, 1, 1, 3]
    for time in times:
        drawn = set(masks.active(masks.interval(time)).tolist())
        assert set(torch.nonzero(scene.at(time).opacities > 1 / 255)[:, 0].tolist()) <= drawn
