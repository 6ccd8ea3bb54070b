"""The last stage of a run: exact, repeatable, the same as pruning the finished run, and drawn with
masks."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from moving_scene import Blinking, Sliding, camera, moving_scene, row_of_balls, still_scene
from tiny_fields import ALL_KINDS, busy_config, cloud, tiny_setup
from torch import Tensor

from dyngs.api.train import train
from dyngs.compress.prune.stage import (
    Importance,
    Pruned,
    PruneStage,
    ScoringViews,
    distinct_cameras,
    highest,
    importance,
    prune_,
    there_after,
)
from dyngs.config import (
    Config,
    DataConfig,
    FreeField,
    McmcStrategy,
    PruneConfig,
    RandomInit,
    RunConfig,
    StaticModel,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.core.camera import Cameras
from dyngs.data.times import evenly_spaced
from dyngs.deform.field import Offsets
from dyngs.deform.free import FreePrimitives, FreeStart
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.densify import Densifier
from dyngs.gaussians.rendering import RenderOptions, contributions, sensitivities
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.runs.checkpoint import checkpoint_paths, load_checkpoint, load_run
from dyngs.training.clock import Stopwatch
from dyngs.training.events import Event, Message, Started, StepDone, TopologyChanged
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import assemble
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
    trainer = assemble(config)
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
    found = prune_(trainer)
    assert found.before == before
    assert isinstance(trainer.model.densifier, Densifier)
    for _ in range(4):
        trainer.step()
    assert len(trainer.model.scene.gaussians) == found.after == before - before // 2


def test_without_a_stage_nothing_changes(still: Path, tmp_path: Path) -> None:
    config = still_config(still, tmp_path / "run", PruneConfig())
    assert config.total_steps == 8
    assert load_run(train(config)).step == 8


@pytest.mark.parametrize("score", ["variation", "sensitivity", "contribution"])
def test_every_score_keeps_as_many(score: str, moving: Path, tmp_path: Path) -> None:
    stage = STAGE.model_copy(update={"score": score})
    trainer = trained(moving_config(moving, tmp_path, "control_nodes", stage))
    before = trainer.model.scene.gaussians.detach()
    found = prune_(trainer)
    after = trainer.model.scene.gaussians
    assert (found.before, found.after) == (len(before), len(after))
    assert found.after == len(before) - len(before) // 2
    assert _all_rows_of(after.means, before.means)
    assert isinstance(trainer.model.scene, DynamicScene)
    assert trainer.num_moving <= len(after)


def _all_rows_of(some: Tensor, everything: Tensor) -> bool:
    return bool((some[:, None] == everything[None]).all(-1).any(1).all())


def test_masks_are_trained_with(moving: Path, tmp_path: Path) -> None:
    """What no key time sees is not drawn, and receives no gradient."""
    trainer = trained(moving_config(moving, tmp_path, "control_nodes"))
    prune_(trainer)
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


def test_the_stage_begins_once_where_training_ends(still: Path, tmp_path: Path) -> None:
    """After its last step, or where a run goes on from there; not in a run without the stage."""
    for resumed in (False, True):
        config = still_config(still, tmp_path)
        trainer = trained(config) if resumed else assemble(config)
        loop = Loop(trainer, config.total_steps, Stopwatch())
        told: list[Event] = []
        loop.subscribe(PruneStage(loop, lambda trainer=trainer: trainer), told.append)
        loop.run()
        (changed,) = [event for event in told if isinstance(event, TopologyChanged)]
        assert changed == TopologyChanged(8, changed.before, changed.before - changed.before // 2)
        assert [event.text.split(":")[0] for event in told if isinstance(event, Message)] == [
            "pruned"
        ]
        assert trainer.num_gaussians == changed.after
        place = told.index(changed)
        assert isinstance(told[place + 1], Started if resumed else StepDone)
    plain = still_config(still, tmp_path, PruneConfig())
    trainer = assemble(plain)
    told = []
    loop = Loop(trainer, plain.total_steps, Stopwatch())
    loop.subscribe(PruneStage(loop, lambda: trainer), told.append)
    loop.run()
    assert not [event for event in told if isinstance(event, TopologyChanged)]


def test_what_it_says() -> None:
    assert str(Pruned(1000, 200, 1.234, 1.0)) == (
        "pruned: 1,000 -> 200 Gaussians, 80.0% removed, -1.23 dB before it is trained again"
    )
    assert str(Pruned(1000, 500, 1.0, 0.75)).endswith("; masks let 75% of them through")


def test_cameras_of_a_standing_rig_are_taken_once() -> None:
    one = camera()
    other = camera()
    moved = Cameras(
        other.cam_from_world + torch.tensor(0.5), other.intrinsics, other.width, other.height
    )
    assert distinct_cameras([one, moved, camera(), moved], 8) == [one, moved]
    assert evenly_spaced(10, 3) == [0, 3, 6]
    assert evenly_spaced(2, 3) == [0, 1]


BLACK = torch.zeros(3)


def views(
    scene: GaussianScene, times: tuple[float | None, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
) -> ScoringViews:
    return ScoringViews(scene, [camera(), camera(40, 28)], times, RenderOptions(), BLACK)


def test_sums_are_over_cameras_at_each_moment() -> None:
    scene = moving_scene(Sliding())
    found = importance(views(scene), slopes=True)
    assert found.fractions.shape == found.log_volumes.shape == found.opacities.shape == (5, 5)
    for k, time in ((0, 0.0), (3, 0.75)):
        both = [contributions(scene.at(time), c)[0] for c in (camera(), camera(40, 28))]
        torch.testing.assert_close(found.fractions[k], both[0] + both[1])
    slopes = [sensitivities(scene.at(t), c, background=BLACK)[0] for t in (0.0, 0.25, 0.5, 0.75, 1.0)
              for c in (camera(), camera(40, 28))]  # fmt: skip
    assert found.slopes is not None
    torch.testing.assert_close(found.slopes, torch.stack(slopes).sum(0))
    assert importance(views(scene), slopes=False).slopes is None


def test_what_is_hidden_or_transparent_is_worth_least() -> None:
    """Of five balls the second lies behind a wall, the fourth is faint."""
    balls = row_of_balls()
    means = balls.means.clone()
    log_scales = balls.log_scales.clone()
    logits = balls.logit_opacities.clone()
    means[0] = torch.tensor([-0.5, 0.0, -1.0])  # before the second, which is at x = -0.5
    log_scales[0] = -1.0
    logits[0] = 9.0
    logits[3] = -4.0
    scene = StaticScene(
        gaussians=balls.replace(means=means, log_scales=log_scales, logit_opacities=logits)
    )
    found = importance(views(scene, (None,)), slopes=True)
    assert found.slopes is not None
    for scores in (found.contribution, found.variation, found.slopes):
        assert set(scores.argsort()[:2].tolist()) == {1, 3}


def constant(
    fractions: list[list[float]], opacities: list[list[float]] | None = None
) -> Importance:
    """K moments of N Gaussians of one size."""
    c = torch.tensor(fractions)
    o = torch.full_like(c, 0.5) if opacities is None else torch.tensor(opacities)
    return Importance(c, None, o, torch.zeros_like(c))


def test_in_a_still_scene_variation_is_twice_the_contribution() -> None:
    """g is 2 where nothing bends, gamma 1 where all are of one size."""
    found = constant([[1.0, 5.0, 0.25]] * 4)
    torch.testing.assert_close(found.variation, 2 * found.contribution)


def test_of_equal_contributions_the_steady_one_is_worth_more() -> None:
    """The second is there at one moment only."""
    found = constant([[1.0, 0.0], [1.0, 0.0], [1.0, 5.0], [1.0, 0.0], [1.0, 0.0]])
    assert found.contribution[0] == found.contribution[1]
    assert found.variation[0] > 1.2 * found.variation[1]


def test_opacity_that_changes_is_the_profile() -> None:
    """1 / (tanh(4 |d|) / 2 + 1/2) by hand: p = (1, 0, 1), d = (-1, 2, -1) with repeated ends."""
    found = constant([[1.0, 1.0]] * 3, [[0.8, 0.5], [0.0, 0.5], [0.8, 0.5]])
    g = [2 / (math.tanh(4 * d) + 1) for d in (1.0, 2.0, 1.0)]
    torch.testing.assert_close(found.variation, torch.tensor([sum(g), 6.0]))


def test_larger_ones_weigh_a_little_more() -> None:
    """The tenth power: e^3 times the volume is e^0.3 times the score."""
    volumes = torch.tensor([[0.0, 3.0]])
    found = Importance(torch.ones(1, 2), None, torch.ones(1, 2), volumes)
    assert float(found.variation[1] / found.variation[0]) == pytest.approx(math.exp(0.3))


def test_one_moment_and_nothing_at_all() -> None:
    assert importance(views(still_scene(), (None,)), slopes=False).variation.shape == (5,)
    found = importance(views(still_scene(0), (None,)), slopes=True)
    assert found.variation.shape == found.contribution.shape == (0,)


def test_scores_are_finite_where_something_is_never_seen() -> None:
    class Fading(Blinking):
        def offsets(self, means, time, rows=None):
            return Offsets(
                torch.zeros(len(means), 3), logit_opacities=torch.full((len(means),), -200.0 * time)
            )

    found = importance(views(moving_scene(Fading(), rows=(0, 1, 2, 3, 4))), slopes=True)
    for scores in (found.variation, found.contribution):
        assert scores.isfinite().all()


SCORES = torch.tensor([3.0, 0.5, 2.0, 0.5, 9.0])


@pytest.mark.parametrize(
    ("fraction", "kept"),
    [(0.0, {0, 1, 2, 3, 4}), (0.2, {0, 1, 2, 4}), (0.4, {0, 2, 4}), (0.79, {0, 4}), (0.99, {4})],
)
def test_the_lowest_go_and_of_equal_ones_the_last(fraction: float, kept: set[int]) -> None:
    assert set(torch.nonzero(highest(SCORES, fraction))[:, 0].tolist()) == kept


@given(st.lists(st.floats(0, 10, width=32), min_size=1, max_size=30), st.floats(0, 0.999))
def test_no_more_go_than_asked_and_none_above_one_that_stays(
    values: list[float], fraction: float
) -> None:
    scores = torch.tensor(values)
    kept = highest(scores, fraction)
    assert 1 <= kept.sum() <= len(scores)
    assert (~kept).sum() <= fraction * len(scores) + 1e-6
    if not bool(kept.all()):
        assert scores[~kept].max() <= scores[kept].min()


def test_what_is_there_for_a_while_is_masked_only_while_it_is_not() -> None:
    """Between key times, too: three of ten training times are key times, and none of the Gaussians
    is there at them."""
    centers = torch.tensor([2, 3, 6, 7]) / 9
    start = FreeStart(torch.zeros(0), (), centers, torch.full((4,), 0.03), torch.zeros(4, 3))
    field = FreePrimitives(FreeField(), tiny_setup(4), torch.Generator()).started(start)
    times = tuple(k / 9 for k in range(10))
    scene = DynamicScene(gaussians=cloud(5), seen_at=times, field=field, moving=torch.arange(4))
    keys = (times[0], times[5], times[9])
    masks = VisibilityMasks.pack(keys, there_after(scene, keys, 1 / 255))
    assert masks.seen.sum(0).tolist() == [1, 1, 1, 1, 3]
    for time in times:
        drawn = set(masks.active(masks.interval(time)).tolist())
        assert set(torch.nonzero(scene.at(time).opacities > 1 / 255)[:, 0].tolist()) <= drawn
