"""Free primitives: flat-top time windows, linear trajectories, splits in time, skipped rows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_fields import cloud, stir, tiny_setup

from dyngs.api.train import train
from dyngs.config.io import load_config
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.deform.free import MIN_SPAN, FreeInitialization, FreePrimitives, initialize_free
from dyngs.deform.initial_motion import TimedGaussians
from dyngs.deform.keys import FreeField
from dyngs.evaluate.report import evaluate_run
from dyngs.gaussians import TopologyEdit

GAP = 1 / 9  # ``tiny_setup`` has ten times


def field_of(
    centers: list[float], spans: list[float], velocities: list[list[float]]
) -> FreePrimitives:
    start = FreeInitialization(
        torch.zeros(0), (), torch.tensor(centers), torch.tensor(spans), torch.tensor(velocities)
    )
    return FreePrimitives(
        FreeField(), tiny_setup(len(centers)), torch.Generator()
    ).with_initialization(start)


def test_paths_are_straight_and_windows_follow_their_definition() -> None:
    """Compared in float64 with the formulas, and gradients with finite differences."""
    field = field_of([0.2, 0.8], [0.1, 0.3], [[1.0, 0.0, 0.0], [0.0, -2.0, 0.5]])
    stir(field, 0.05)
    p = {name: x.double().requires_grad_() for name, x in field.parameters.values().items()}
    for name, x in p.items():
        field.parameters._tensors[name] = x  # pyright: ignore[reportPrivateUsage]
    means = torch.zeros(2, 3, dtype=torch.float64)

    def at(*learned: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        for name, x in zip(("centers", "log_spans", "velocities"), learned, strict=True):
            field.parameters._tensors[name] = x  # pyright: ignore[reportPrivateUsage]
        found = field.offsets(means, 0.37)
        assert found.logit_opacities is not None
        return found.means, found.logit_opacities

    shift, window = at(p["centers"], p["log_spans"], p["velocities"])
    torch.testing.assert_close(shift, p["velocities"] * (0.37 - p["origins"]))
    spans = p["log_spans"].exp() + MIN_SPAN * GAP
    torch.testing.assert_close(window, (-((0.37 - p["centers"]) ** 2) / (2 * spans**2))[:, 0])
    assert torch.autograd.gradcheck(at, (p["centers"], p["log_spans"], p["velocities"]))


def test_new_gaussians_lie_on_the_same_trajectory() -> None:
    """Two copies of one source get both signs. All stay within the clip, and existing ones are
    unchanged.
    """
    field = field_of([0.5, 0.0], [0.1, 0.1], [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    edit = TopologyEdit(
        torch.tensor([1, 0, 0, 1, 1]), torch.tensor([False, True, True, True, True])
    )
    children = field.apply_edit(edit)
    centers = children.parameters["centers"].detach()[:, 0]
    assert sorted(centers[1:3].tolist()) == pytest.approx([0.45, 0.55])
    assert centers[0] == 0
    assert sorted(centers[3:].tolist()) == pytest.approx([0.0, 0.05])
    moved, before = (
        x.offsets(torch.zeros(5, 3)[: len(x.parameters["centers"])], 0.7) for x in (children, field)
    )
    torch.testing.assert_close(moved.means[1:3], before.means[:1].expand(2, 3))


def test_unseen_gaussians_are_not_updated() -> None:
    """Adam's momentum does not move them: only the Gaussian with a gradient is updated."""
    field = field_of([0.2, 0.8], [0.1, 0.1], [[0.0, 0.0, 0.0]] * 2)
    for step in range(1, 4):
        shown = slice(0, 2) if step == 1 else slice(0, 1)
        before = {name: x.clone() for name, x in field.parameters.values().items()}
        found = field.offsets(torch.zeros(2, 3), 0.4)
        assert found.logit_opacities is not None
        (found.means[shown].sum() + found.logit_opacities[shown].sum()).backward()
        field.parameters.step(step, 0.0)
        for name, x in field.parameters.values().items():
            changed = (x != before[name]).any(1).tolist()
            assert changed == ([False, False] if name == "origins" else [True, step == 1]), name


def test_static_gaussians_are_copied_over_the_clip_and_moments_have_their_times() -> None:
    static = cloud(3)
    thing = cloud(5)
    others = cloud(4)
    velocity = torch.tensor([1.0, 0.0, 2.0]).expand(5, 3)
    start = initialize_free(static, [TimedGaussians(0.25, thing, velocity)], others, num_times=10)
    assert [len(x) for x in start.added] == [3] * 9 + [5, 4]
    assert len(start.centers) == len(start.spans) == len(start.velocities) == 30 + 5 + 4
    assert start.centers[:30:3].tolist() == pytest.approx([0.05 + 0.1 * i for i in range(10)])
    assert (start.spans[:30] == 0.1).all()
    assert (start.centers[30:35] == 0.25).all()
    assert (start.spans[30:35] < GAP).all()
    assert torch.equal(start.velocities[30:35], velocity)
    assert not start.velocities[35:].any()


def test_a_rolling_ball_before_fixed_cameras_is_learned(tmp_path: Path) -> None:
    """PSNR of moving regions in views between the cameras is higher than with control nodes."""
    options = DynamicOptions(
        size=56, num_times=6, num_cameras=8, num_test=6, samples=1, style="fixed"
    )
    capture = write_dynamic_capture("roll", tmp_path / "capture", options)
    keys = [
        "train.steps=360",
        "train.initial_downscale=1",
        "train.alpha_weight=0.1",
        "model.pilot_runs=false",
    ]
    keys += ["model.deform.kind=free", "model.num_random_moving=400", "strategy.max_gaussians=3000"]
    places = [
        f"data.root={capture}",
        f"run.dir={tmp_path / 'run'}",
        "run.threads=1",
        "init.num_random=1000",
    ]
    train(load_config("dynamic", [*places, *keys]))
    found = evaluate_run(tmp_path / "run").psnr_moving
    assert found is not None
    assert found > 13.5
