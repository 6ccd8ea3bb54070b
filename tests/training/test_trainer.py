"""One step: any kind of scene is trained, on the right background, and bad gradients do no harm."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import TRAIN_TIMES, write_timed_capture
from torch import Tensor

from dyngs.config import Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, with_role
from dyngs.data.images.images import read_image
from dyngs.data.loader import Image
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.model import SceneTraining
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep
from dyngs.io.tensor_file import write_tensors
from dyngs.io.write import write_image
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import _KIND, load_checkpoint
from dyngs.training.new_trainer import GaussianTrainer, build_trainer
from dyngs.training.trainer import ViewSampler


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=2, num_test=1, samples=1))
    return folder


def _trainer(capture: Path, **data: object) -> GaussianTrainer:
    return build_trainer(
        Config(
            data=DataConfig(root=capture, **data),  # type: ignore[arg-type]
            model=StaticModel(sh_degree=1),
            init=RandomInit(num_random=50),
            train=TrainConfig(steps=100),
            run=RunConfig(threads=1),
        )
    )


@dataclass(frozen=True, kw_only=True)
class _LiftedScene(GaussianScene):
    """A scene of another kind: all Gaussians are drawn a little higher than they are stored."""

    @property
    def times(self) -> tuple[float, ...]:
        return ()

    @property
    def is_static(self) -> bool:
        return False

    @property
    def rows(self) -> Tensor:
        return torch.arange(len(self))

    def time_step(self, time: float | None) -> GaussianTimeStep:
        return GaussianTimeStep(
            self.gaussians.replace(means=self.gaussians.means + torch.tensor([0.0, 0.0, 0.1])), time
        )

    def apply_edit(self, edit: TopologyEdit) -> _LiftedScene:
        return replace(self, gaussians=self.gaussians.apply_edit(edit))

    def _model_state(self) -> State:
        return {}


class _Lifted(SceneTraining[_LiftedScene]):
    """Training of a lifted scene; the list of finished steps is part of its state."""

    deformation_name = ("field", "model.deform")

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.penalty = 0.0

    def trains_on(self, time: float | None, step: int) -> bool:
        return True

    def time_step(self, scene: _LiftedScene, image: Image, step: int) -> GaussianTimeStep:
        penalties = (
            {"height": self.penalty * scene.gaussians.means[:, 2].abs().sum()}
            if self.penalty
            else {}
        )
        return replace(scene.time_step(image.time), penalties=penalties)

    def optimize(self, scene: _LiftedScene, step: int) -> int:
        self.steps.append(step)
        return 3

    def after_step(self, scene: _LiftedScene, step: int, edited: bool) -> _LiftedScene:
        return scene

    def edit_scene(self, scene: _LiftedScene, step: int) -> tuple[_LiftedScene, EditResult] | None:
        return None

    def window(self, step: int) -> tuple[float, float]:
        return 0.0, 1.0

    def extend(self, scene: _LiftedScene, seen: tuple[float, float], step: int) -> None:
        raise NotImplementedError

    def apply_edit(self, edit: TopologyEdit) -> None: ...

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> _LiftedScene:
        self.steps = tensors["steps"].tolist()
        return _LiftedScene(gaussians=gaussians)

    def state(self) -> State:
        return with_role({"steps": torch.tensor(self.steps)}, Role.TRAINING)


def _trained_by(trainer: GaussianTrainer, training: SceneTraining[Any]) -> GaussianTrainer:
    """``trainer`` with its Gaussians in a scene of another kind."""
    trainer.model.training = training
    trainer.model.replace_scene(_LiftedScene(gaussians=trainer.model.scene.gaussians))
    return trainer


def test_a_scene_of_another_kind_is_trained(capture: Path) -> None:
    training = _Lifted()
    trainer = _trained_by(_trainer(capture), training)
    before = trainer.model.scene.gaussians.means.detach().clone()
    losses = [trainer.step().loss for _ in range(30)]
    assert training.steps == list(range(1, 31))
    assert sum(losses[-4:]) < sum(losses[:4])
    assert not torch.equal(trainer.model.scene.gaussians.means, before)
    other = _trained_by(_trainer(capture), _Lifted())
    other.restore(trainer.checkpoint())
    assert other.step().loss == trainer.step().loss
    assert trainer.bad_gradients == 3 * 31


class _Exploding(_Lifted):
    """From step 3 on it draws positions and rotations that are not finite."""

    def time_step(self, scene: _LiftedScene, image: Image, step: int) -> GaussianTimeStep:
        if step < 3:
            return super().time_step(scene, image, step)
        now = scene.gaussians
        factor = float("nan")
        return GaussianTimeStep(
            now.replace(means=now.means * factor, quats=now.quats * factor), image.time
        )


def _stops_in_step_3(trainer: GaussianTrainer) -> str:
    """The error's message; the trainer is left as after step 2."""
    trainer.step()
    trainer.step()
    before = {
        name: x.detach().clone() for name, x in trainer.model.scene.gaussians.tensors().items()
    }
    with pytest.raises(DyngsError) as caught:
        trainer.step()
    assert trainer.done == 2
    assert all(
        torch.equal(x, before[name]) for name, x in trainer.model.scene.gaussians.tensors().items()
    )
    return str(caught.value)


@pytest.mark.parametrize("timed", [False, True])
def test_non_finite_values_are_named_in_one_line(
    capture: Path, tmp_path: Path, timed: bool
) -> None:
    """Step, view, attributes, and the time; the parameters stay as they were."""
    trainer = _trained_by(
        _trainer(write_timed_capture(tmp_path / "timed") if timed else capture), _Exploding()
    )
    time = "(0|0.25|0.5|0.75|1)" if timed else "0"
    assert re.fullmatch(
        rf"step 3, view 'train/r_00\d': the field produced non-finite means at time {time}; "
        r"lower .*model\.deform",
        _stops_in_step_3(trainer),
    )


def test_only_times_that_the_training_wants_are_trained_on(tmp_path: Path) -> None:
    class _Early(_Lifted):
        def trains_on(self, time: float | None, step: int) -> bool:
            return time is not None and time <= 0.1 * step

    trainer = _trained_by(_trainer(write_timed_capture(tmp_path)), _Early())
    seen = [trainer.step().image.time for _ in range(40)]
    assert all(time is not None and time <= 0.1 * (i + 1) for i, time in enumerate(seen))
    assert set(seen[20:]) == set(TRAIN_TIMES)


def test_a_checkpoint_of_another_model_is_refused(capture: Path) -> None:
    trainer = _trainer(capture)
    checkpoint = trainer.checkpoint()
    del checkpoint.tensors["sampler.order"]
    with pytest.raises(DyngsError, match="lacks 'order'"):
        trainer.restore(checkpoint)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        (
            "exp_avg.means",
            lambda x: x[1:],
            r"'exp_avg.means' is float32 \(49, 3\), not float32 \(50, 3\)",
        ),
        ("exp_avg_sq.sh", lambda x: x[:, :1], "'exp_avg_sq.sh' is float32"),
        ("exp_avg.quats", lambda x: x.double(), "'exp_avg.quats' is float64"),
        ("exp_avg_sq.means", lambda x: x / 0, "'exp_avg_sq.means' has NaN"),
        ("gaussians.quats", lambda x: x[:, :3], "quats must be"),
        ("sampler.order", lambda x: torch.tensor([7]), "'order' has indices outside"),
        ("sampler.position", lambda x: x + 99, "'position' has indices outside"),
        ("strategy.seen", lambda x: x.long(), "'seen' is int64"),
        ("rng", lambda x: x[:9], "cannot be read"),
        ("rng", lambda x: x.float(), "cannot be read"),
    ],
)
def test_a_state_that_does_not_fit_is_one_line(
    capture: Path, tmp_path: Path, name: str, change: Callable[[Tensor], Tensor], said: str
) -> None:
    trainer = _trainer(capture)
    trainer.step()
    whole = trainer.checkpoint()
    path = tmp_path / "checkpoints" / "step_0000001.safetensors"
    path.parent.mkdir()
    tensors = whole.tensors | {name: change(whole.tensors[name])}
    write_tensors(
        path, _KIND, {name: x.contiguous() for name, x in tensors.items()}, asdict(whole.info)
    )
    with pytest.raises(DyngsError, match=said) as caught:
        trainer.restore(load_checkpoint(path))
    assert str(caught.value).startswith(str(path))
    trainer.restore(whole)
    trainer.step()


def with_images(
    capture: Path, out: Path, edit: Callable[[np.ndarray], np.ndarray], mask: np.ndarray | None
) -> Path:
    """Return a copy of a capture whose training images are edited, and have a mask."""
    shutil.copytree(capture, out)
    frames = json.loads((out / "transforms_train.json").read_text())
    for view in read_capture(out).splits["train"]:
        write_image(view.image_path, edit(read_image(view.image_path).numpy()))
    if mask is not None:
        write_image(out / "mask.png", mask)
        frames["frames"] = [frame | {"mask_path": "mask.png"} for frame in frames["frames"]]
    (out / "transforms_train.json").write_text(json.dumps(frames))
    return out


def trained_state(root: Path) -> dict[str, Tensor]:
    trainer = _trainer(root)
    for _ in range(4):
        trainer.step()
    return trainer.model.scene.gaussians.tensors()


def test_pixels_ignored_by_a_mask_have_no_effect(capture: Path, tmp_path: Path) -> None:
    """White counts, black is ignored: other colours below black change nothing, below white they
    do."""
    mask = np.full((16, 16, 1), 255, np.uint8)
    mask[:, 8:] = 0

    def repainted(columns: slice) -> Callable[[np.ndarray], np.ndarray]:
        def edit(pixels: np.ndarray) -> np.ndarray:
            pixels[:, columns, :3] = 255 - pixels[:, columns, :3]
            pixels[..., 3] = 255
            return pixels

        return edit

    nothing, ignored, counting = (
        trained_state(with_images(capture, tmp_path / name, repainted(columns), mask))
        for name, columns in (("a", slice(0, 0)), ("b", slice(8, 16)), ("c", slice(0, 8)))
    )
    assert all(torch.equal(x, ignored[name]) for name, x in nothing.items())
    assert not torch.equal(nothing["sh"], counting["sh"])


def test_two_equal_views_in_a_step_are_one_seen_twice(tmp_path: Path) -> None:
    """The mean of two equal gradients has the bytes of either; densification counts both views."""
    write_static_capture(tmp_path, StaticOptions(size=16, num_train=1, num_test=1, samples=1))
    states = []
    for batch in (1, 2):
        trainer = _trainer(tmp_path)
        trainer.config = trainer.config.model_copy(
            update={"train": TrainConfig(steps=100, batch_size=batch)}
        )
        losses = [trainer.step().loss for _ in range(4)]
        states.append(
            (
                trainer.model.scene.gaussians.detach().tensors(),
                trainer.model.densifier.state(),
                losses,
            )
        )
    (one, seen, losses), (two, twice, others) = states
    assert all(torch.equal(x, two[name]) for name, x in one.items())
    assert torch.equal(2 * seen["seen"], twice["seen"])
    torch.testing.assert_close(2 * seen["grad_sum"], twice["grad_sum"])
    assert losses == pytest.approx(others, rel=1e-6)


def anything(index: int) -> bool:
    return True


def test_each_epoch_is_a_new_permutation() -> None:
    sampler = ViewSampler(20)
    generator = torch.Generator().manual_seed(0)
    first, second = ([sampler.next(generator, anything) for _ in range(20)] for _ in range(2))
    assert sorted(first) == sorted(second) == list(range(20))
    assert first != second


def test_a_restored_sampler_goes_on_as_if_never_stopped() -> None:
    sampler = ViewSampler(5)
    generator = torch.Generator().manual_seed(1)
    for _ in range(7):
        sampler.next(generator, anything)
    other = ViewSampler(5)
    again = torch.Generator()
    other.load_state({name: x.clone() for name, x in sampler.state().items()})
    again.set_state(generator.get_state())
    assert [sampler.next(generator, anything) for _ in range(9)] == [
        other.next(again, anything) for _ in range(9)
    ]


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 9), min_size=1), st.integers(0, 100))
def test_only_what_is_wanted_is_drawn_and_each_once_per_epoch(wanted: set[int], seed: int) -> None:
    sampler = ViewSampler(10)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(3):
        epoch = [sampler.next(generator, lambda i: i in wanted) for _ in wanted]
        assert sorted(epoch) == sorted(wanted)
