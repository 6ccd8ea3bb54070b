"""Training that starts from an existing scene: the initial state and the frozen parameters."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import write_moving_run

from dyngs.api.edit import Edits, edit_scene
from dyngs.api.first_scene import load_initial_gaussians
from dyngs.api.stages import continue_scene
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config import Config, FixedStrategy
from dyngs.config.io import load_config, load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.export.edit.frame import Frame
from dyngs.export.splat_files import write_run_splats
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.densify import Densifier
from dyngs.runs.opened import open_run
from dyngs.training.new_trainer import build_trainer
from dyngs.training.plan import RunPlan

BOX = (-9.0, -9.0, -9.0, 0.0, 9.0, 9.0)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = StaticOptions(size=24, num_train=6, num_test=2, samples=1)
    return write_static_capture(tmp_path_factory.mktemp("capture"), options)


@pytest.fixture(scope="module")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "first"
    return train(
        config_of(
            capture,
            folder,
            "init.kind=random",
            "init.num_random=60",
            "strategy.kind=fixed",
            steps=8,
        )
    )


def config_of(capture: Path, folder: Path, *more: str, steps: int = 8) -> Config:
    words = (
        f"data.root={capture}",
        f"run.dir={folder}",
        f"train.steps={steps}",
        "run.threads=1",
        *more,
    )
    return load_config(Path("static"), list(words))


def going_on(capture: Path, run: Path, folder: Path, *more: str, steps: int = 8) -> Config:
    return config_of(capture, folder, "init.kind=scene", f"init.scene={run}", *more, steps=steps)


def settled(config: Config) -> Config:
    return continue_scene(RunPlan(config, config)).resolved


def rows_of(gaussians: Gaussians) -> set[bytes]:
    """All that a Gaussian is, as bytes, without an order."""
    values = torch.cat(
        [x.detach().reshape(len(x), -1) for x in gaussians.tensors().values()], dim=1
    )
    return {row.numpy().tobytes() for row in values}


def psnr_of(run: Path) -> float:
    return evaluate_run(run).psnr


@pytest.mark.parametrize("kind", ["run", "file"])
def test_training_starts_from_the_scene(
    kind: str, capture: Path, run: Path, tmp_path: Path
) -> None:
    source = run if kind == "run" else write_run_splats(open_run(run), tmp_path / "a.ply").path
    config = settled(going_on(capture, source, tmp_path / "new"))
    first = load_initial_gaussians(config, read_capture(config.data))
    assert first is not None
    assert first.frozen is None
    old = open_run(run).scene.gaussians
    if kind == "run":
        assert all(
            torch.equal(x, old.tensors()[name]) for name, x in first.gaussians.tensors().items()
        )
    new = train(
        going_on(
            capture,
            source,
            tmp_path / "new",
            "optim.rate_factor=1e-9",
            "strategy.kind=fixed",
            steps=1,
        )
    )
    assert psnr_of(new) == pytest.approx(psnr_of(run), abs=0.01)


class Wild(Densifier):
    """Doubles every Gaussian beside itself, makes all fainter, and shakes them, in every step."""

    touches_all = True

    def edit(self, step: int, parameters: Gaussians, generator: torch.Generator) -> EditResult:
        source = torch.arange(len(parameters)).repeat(2)
        edit = TopologyEdit(source, torch.arange(len(source)) >= len(parameters))
        faint = parameters.logit_opacities.detach()[source] - 0.1
        return EditResult(
            edit, {"means": parameters.means.detach()[source] + 0.01, "logit_opacities": faint}
        )

    def perturb(self, parameters: Gaussians, lr_means: float, generator: torch.Generator) -> None:
        parameters.means.detach().add_(0.001)


def test_gaussians_outside_the_box_keep_their_bytes(
    capture: Path, run: Path, tmp_path: Path
) -> None:
    """While the set grows, is shaken and ordered anew around it; also from a checkpoint."""
    config = settled(
        going_on(capture, run, tmp_path / "new", f"init.box={list(BOX)}", "strategy.kind=fixed")
    )
    first = load_initial_gaussians(config, read_capture(config.data))
    assert first is not None
    assert first.frozen is not None
    frozen, free = (first.gaussians.select(x) for x in (first.frozen, ~first.frozen))
    assert 0 < len(frozen) < len(first.frozen)
    trainer = build_trainer(config, first=first)
    again = build_trainer(config, restored=True)
    for one in (trainer, again):
        if one is again:
            again.restore(trainer.checkpoint())
        one.model.densifier = Wild()
        for _ in range(2):
            one.step()
        rows = rows_of(one.model.scene.gaussians)
        assert rows_of(frozen) <= rows
        assert not rows_of(free) & rows
    assert again.num_gaussians == len(frozen) + 16 * len(free)


def test_colour_only(capture: Path, run: Path, tmp_path: Path) -> None:
    new = train(going_on(capture, run, tmp_path / "new", "init.trainable=colour"))
    before = open_run(run).scene.gaussians.tensors()
    after = open_run(new).scene.gaussians.tensors()
    assert not torch.equal(before["sh"], after["sh"])
    assert all(torch.equal(before[name], x) for name, x in after.items() if name != "sh")
    assert isinstance(load_resolved(new).strategy, FixedStrategy)
    assert psnr_of(new) > psnr_of(run) - 0.5


def test_an_edited_run_goes_on_with_its_own_cameras(
    capture: Path, run: Path, tmp_path: Path
) -> None:
    frame = Frame(scale=2.0, origin=(0.25, 0.0, 0.0))
    edited = edit_scene(run, tmp_path / "edited", Edits(frame=frame), tell=lambda _: None).path
    assert (
        main(["export", str(edited), "--format", "cameras", "--out", str(tmp_path / "cameras")])
        == 0
    )
    config = going_on(tmp_path / "cameras", edited, tmp_path / "new", "data.follow_links=true")
    first = load_initial_gaussians(config, read_capture(config.data))
    assert first is not None
    again = read_capture(config.data)
    moved = open_run(edited).frame.gaussians(open_run(run).scene.gaussians)
    means = again.world_scale * first.gaussians.means
    torch.testing.assert_close(means, moved.means)


def test_unsupported_first_scenes_are_refused(capture: Path, run: Path, tmp_path: Path) -> None:
    moving = write_moving_run(tmp_path)
    for source, more, said in (
        (moving, [], "a moving scene; training starts from static scenes"),
        (run, ["init.box=[8,8,8,9,9,9]"], "init.box: none of .* Gaussians of .* lie in it"),
        (tmp_path / "none.ply", [], "no such file"),
        (run, ["model.kind=ngp"], "init.kind=scene goes with model.kind=static, not with ngp"),
    ):
        with pytest.raises(DyngsError, match=said) as caught:
            train(going_on(capture, source, tmp_path / "new", *more, steps=2))
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "new" / "checkpoints").exists()
    assert (
        main(["train", "static", f"data.root={capture}", "--from", str(run), "--resume", str(run)])
        == 2
    )
