"""Models and trainers that are built from a configuration."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    OptimConfig,
    PointsInit,
    RandomInit,
    TrainConfig,
)
from dyngs.config.io import load_config, packaged_presets
from dyngs.core.state import strip_roles
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import (
    DynamicOptions,
    StaticOptions,
    write_dynamic_capture,
    write_static_capture,
)
from dyngs.deform.keys import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.deform.training import DynamicTraining
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.write import write_image
from dyngs.models.static_section import StaticModel
from dyngs.models.views import training_times
from dyngs.training.losses import SilhouetteLoss
from dyngs.training.new_trainer import add_initial_points, build_trainer


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=5, num_test=1, samples=1))
    return folder


def _with_times(capture: Path, out: Path, times: list[float] | None) -> Path:
    """A copy of the capture whose training images have these times, and whose test images are taken
    at 0.5."""
    shutil.copytree(capture, out)
    for split in ("train", "test"):
        file = out / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for i, frame in enumerate(document["frames"]):
            frame |= {} if times is None else {"time": times[i] if split == "train" else 0.5}
        file.write_text(json.dumps(document))
    return out


def _dynamic(capture: Path, **changes: object) -> Config:
    config = Config(
        data=DataConfig(root=capture),
        model=DynamicModel(sh_degree=1),
        init=RandomInit(num_random=50),
        strategy=DefaultStrategy(start=1, stop=30_000, every=3, grad_threshold=1e-6),
        optim=OptimConfig(rate_factor=1),  # whether it moves or not
        train=TrainConfig(steps=12),
    )
    return config.model_copy(update=changes)


def test_times_make_a_dynamic_model(capture: Path, tmp_path: Path) -> None:
    root = _with_times(capture, tmp_path / "timed", [0.5, 0.0, 1.0, 0.5, 0.25])
    assert training_times(read_capture(DataConfig(root=root))) == (0.0, 0.25, 0.5, 0.5, 1.0)
    trainer = build_trainer(_dynamic(root))
    assert isinstance(trainer.model.scene, DynamicScene)
    assert isinstance(trainer.model.training, DynamicTraining)
    assert trainer.model.scene.times == (0.0, 0.25, 0.5, 1.0)
    assert trainer.model.training.schedule.rates.steps == 12
    assert isinstance(build_trainer(_dynamic(root, model=StaticModel())).model.scene, StaticScene)


def test_opacity_is_trained_in_all_presets_but_those_of_published_protocols(
    capture: Path,
) -> None:
    presets = {name: load_config(name, [f"data.root={capture}"]) for name in packaged_presets()}
    weights = {name: config.train.alpha_weight for name, config in presets.items()}
    others = {"ngp": 0.01, "nerf": 0.01}  # errors of colour are squared
    others |= dict.fromkeys(("blender", "4dgs", "deformable_3dgs"), 0.0)
    assert weights == {name: others.get(name, 0.1) for name in presets}

    few = [f"data.root={capture}", "init.kind=random", "init.num_random=30"]

    def weight(*keys: str) -> float:
        trainer = build_trainer(load_config("static", [*few, *keys]))
        losses = [x for x in trainer.losses if isinstance(x, SilhouetteLoss)]
        return losses[0].weight

    assert weight() == 0.1
    assert weight("train.alpha_weight=0.3") == 0.3


@pytest.mark.parametrize(("level", "early"), [(0.95, 1.0), (0.5, 0.2)], ids=["white", "grey"])
def test_opacity_counts_less_before_motion_is_followed_unless_things_are_white(
    capture: Path, tmp_path: Path, level: float, early: float
) -> None:
    root = _with_times(capture, tmp_path / "timed", [0.5, 0.0, 1.0, 0.5, 0.25])
    for file in root.rglob("*.png"):
        pixels = read_image(file).numpy().copy()
        pixels[..., :3] = round(255 * level)
        write_image(file, pixels)

    def early_fraction(config: Config) -> float:
        return next(x.early for x in build_trainer(config).losses if isinstance(x, SilhouetteLoss))

    assert early_fraction(_dynamic(root)) == early
    assert early_fraction(_dynamic(root, model=StaticModel())) == early, "both begin alike"
    assert early_fraction(_dynamic(capture, model=StaticModel())) == 1.0, "no times"
    black = DataConfig(root=root, background="black")
    assert early_fraction(_dynamic(root, data=black)) == 0.2


def test_points_are_triangulated_where_several_cameras_show_a_moment(tmp_path: Path) -> None:
    """The scene has one Gaussian per triangulated point of the room. Without triangulation, the
    points are random."""
    options = DynamicOptions(size=96, num_times=2, num_cameras=8, num_test=0, samples=1)
    root = write_dynamic_capture("room", tmp_path / "room", options)
    config = _dynamic(root, init=PointsInit(num_random=7))
    found = add_initial_points(read_capture(config.data), config).points
    assert found is not None
    assert len(build_trainer(config).model.scene) == len(found.xyz) > 7
    without = config.model_copy(update={"init": PointsInit(num_random=7, triangulate=0)})
    assert len(build_trainer(without).model.scene) == 7


def test_the_coarse_phase_is_static_training(capture: Path, tmp_path: Path) -> None:
    """Until something moves, a dynamic run is a static one, byte by byte, on all views."""
    root = _with_times(capture, tmp_path / "timed", [0.0, 0.25, 0.5, 0.75, 1.0])
    static, dynamic = (
        build_trainer(_dynamic(root, model=m))
        for m in (StaticModel(), DynamicModel(motion_from=1.0))
    )
    for _ in range(8):
        assert static.step().loss == dynamic.step().loss
    mine, others = (strip_roles(trainer.model.state()) for trainer in (static, dynamic))
    moments = [name for name in mine if name.startswith("exp_avg")]
    assert moments
    assert all(torch.equal(mine[name], others[name]) for name in moments)
