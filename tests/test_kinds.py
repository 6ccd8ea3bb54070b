"""What a configuration is turned into."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.config import (
    BudgetConfig,
    Config,
    DataConfig,
    DefaultStrategy,
    DynamicModel,
    FixedStrategy,
    McmcStrategy,
    OptimConfig,
    PointsInit,
    RandomInit,
    StaticModel,
    TrainConfig,
)
from dyngs.config.io import load_config, packaged_presets
from dyngs.core.conventions import RasterizeMode
from dyngs.core.state import tensors_of
from dyngs.data.images.images import read_image
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import (
    DynamicOptions,
    StillOptions,
    write_dynamic_capture,
    write_still_capture,
)
from dyngs.deform.scene import DynamicScene
from dyngs.deform.still_error import still_errors
from dyngs.deform.training import DynamicTraining
from dyngs.gaussians.densify import DefaultDensifier, Densifier, McmcDensifier
from dyngs.gaussians.start import surroundings
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.write import write_image
from dyngs.models.views import resolved_background, training_cameras, training_times
from dyngs.training.losses import SilhouetteLoss
from dyngs.training.new_trainer import assemble, with_points


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=5, num_test=1, samples=1))
    return folder


def test_training_cameras_are_those_of_the_images(capture: Path) -> None:
    options = DataConfig(root=capture, downscale=2)
    views = read_capture(options).splits["train"]
    images = ImageLoader(views, options)
    for camera, image in zip(
        training_cameras(views, options), (images[i] for i in range(5)), strict=True
    ):
        assert (
            (camera.width, camera.height) == (image.cameras.width, image.cameras.height) == (8, 8)
        )
        assert torch.equal(camera.intrinsics, image.cameras.intrinsics)
        assert torch.equal(camera.cam_from_world, image.cameras.cam_from_world)


def test_surroundings_of_a_blender_capture(capture: Path) -> None:
    scene = surroundings(read_capture(DataConfig(root=capture)))
    np.testing.assert_allclose(np.linalg.norm(scene.camera_centers, axis=1), 4.0, rtol=1e-5)
    assert scene.around_origin
    assert scene.extent < 1.1 * 8


def test_parts_follow_the_config(capture: Path) -> None:
    config = Config(
        data=DataConfig(root=capture),
        model=StaticModel(
            rasterize_mode=RasterizeMode.ANTIALIASED,
            eps2d=0.1,
            near=0.5,
            sh_degree=2,
            alpha_min=0.01,
        ),
        init=PointsInit(num_random=40),
        strategy=DefaultStrategy(absgrad=True),
    )
    trainer = assemble(config)
    assert isinstance(trainer.model.densifier, DefaultDensifier)
    assert (
        trainer.model.options.mode,
        trainer.model.options.eps2d,
        trainer.model.options.near,
    ) == (
        RasterizeMode.ANTIALIASED,
        0.1,
        0.5,
    )
    assert trainer.model.options.absgrad
    assert trainer.model.options.alpha_min == 0.01
    assert trainer.model.scene.gaussians.sh.shape == (40, 9, 3)
    assert (trainer.background, trainer.has_test_views, len(trainer.images)) == ("white", True, 5)
    mcmc = assemble(config.model_copy(update={"strategy": McmcStrategy(max_gaussians=30)}))
    assert isinstance(mcmc.model.densifier, McmcDensifier)
    assert len(mcmc.model.scene) == 30
    assert not mcmc.model.options.absgrad


def test_a_fixed_set_of_gaussians_stays(capture: Path) -> None:
    config = Config(
        data=DataConfig(root=capture),
        model=StaticModel(filter_3d=True),
        init=RandomInit(num_random=30, half_extent=1.0),
        strategy=FixedStrategy(),
        budget=BudgetConfig(max_gaussians=20),
    )
    trainer = assemble(config)
    assert isinstance(trainer.model.densifier, Densifier)
    trainer.step()
    assert len(trainer.model.scene.gaussians) == 30, (
        "a limit on their number removes some later on, none are added"
    )


def test_auto_background_is_white_only_behind_alpha(capture: Path) -> None:
    read = read_capture(DataConfig(root=capture))
    config = Config(data=DataConfig(root=capture))
    assert resolved_background(config, read) == "white"
    assert resolved_background(config, read.replace(has_alpha=False)) == "black"
    chosen = Config(data=DataConfig(root=capture, background="random"))
    assert resolved_background(chosen, read) == "random"


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
    trainer = assemble(_dynamic(root))
    assert isinstance(trainer.model.scene, DynamicScene)
    assert isinstance(trainer.model.training, DynamicTraining)
    assert trainer.model.scene.times == (0.0, 0.25, 0.5, 1.0)
    assert trainer.model.training.schedule.rates.steps == 12
    assert isinstance(assemble(_dynamic(root, model=StaticModel())).model.scene, StaticScene)


def test_opacity_is_trained_in_all_presets_but_that_of_the_published_protocol(
    capture: Path,
) -> None:
    """That one prints a line when training begins, not when a run is resumed."""
    presets = {name: load_config(name, [f"data.root={capture}"]) for name in packaged_presets()}
    weights = {name: config.train.alpha_weight for name, config in presets.items()}
    others = {"blender": 0.0, "ngp": 0.01, "nerf": 0.01}  # fields: errors of colour are squared
    assert weights == {name: others.get(name, 0.1) for name in presets}

    few = [f"data.root={capture}", "init.kind=random", "init.num_random=30"]

    def weight_and_findings(
        name: str, *keys: str, restored: bool = False
    ) -> tuple[float, list[str]]:
        trainer = assemble(load_config(name, [*few, *keys]), restored=restored)
        losses = [x for x in trainer.losses if isinstance(x, SilhouetteLoss)]
        return losses[0].weight, trainer.findings

    assert weight_and_findings("static") == (0.1, [])
    weight, (line,) = weight_and_findings("blender")
    assert weight == 0.0
    assert "compared on white alone, as published (train.alpha_weight=0)" in line
    assert weight_and_findings("blender", restored=True) == (0.0, [])
    assert weight_and_findings("blender", "data.background=random") == (0.0, [])
    assert weight_and_findings("static", "train.alpha_weight=0.3") == (0.3, [])


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
        return next(x.early for x in assemble(config).losses if isinstance(x, SilhouetteLoss))

    assert early_fraction(_dynamic(root)) == early
    assert early_fraction(_dynamic(root, model=StaticModel())) == early, "both begin alike"
    assert early_fraction(_dynamic(capture)) == 1.0, "no times"
    black = DataConfig(root=root, background="black")
    assert early_fraction(_dynamic(root, data=black)) == 0.2


def test_a_run_of_an_earlier_version_that_left_the_weight_open_can_be_read() -> None:
    assert TrainConfig.model_validate({"alpha_weight": None}) == TrainConfig()


@pytest.mark.parametrize("times", [None, [0.5] * 5], ids=["no times", "one time"])
@pytest.mark.parametrize("filter_3d", [False, True])
def test_without_times_a_dynamic_config_is_a_static_one(
    capture: Path, tmp_path: Path, times: list[float] | None, filter_3d: bool
) -> None:
    """The same bytes after some steps, among them changes of the set."""
    root = _with_times(capture, tmp_path / "capture", times)
    results = []
    for model in (
        DynamicModel(sh_degree=1, filter_3d=filter_3d),
        StaticModel(sh_degree=1, filter_3d=filter_3d),
    ):
        trainer = assemble(_dynamic(root, model=model))
        assert isinstance(trainer.model.scene, StaticScene)
        for _ in range(8):
            trainer.step()
        results.append(trainer.checkpoint())
    assert len(results[0].tensors["gaussians.means"]) != 50
    assert results[0].info == results[1].info
    assert results[0].tensors.keys() == results[1].tensors.keys()
    assert all(torch.equal(x, results[1].tensors[name]) for name, x in results[0].tensors.items())


def test_motion_is_looked_for_in_images_from_all_over_the_clip(
    capture: Path, tmp_path: Path
) -> None:
    """Drawn as in training, on the background of the evaluation."""
    root = _with_times(capture, tmp_path / "timed", [0.5, 0.0, 1.0, 0.5, 0.25])
    trainer = assemble(_dynamic(root, data=DataConfig(root=root, background="white")))
    assert isinstance(trainer.model.training, DynamicTraining)
    gaussians = trainer.model.scene.gaussians.detach()
    found = trainer.model.training.capture.still_errors(lambda _: gaussians)
    images = [trainer.images[i] for i in range(5)]
    expected = still_errors(lambda _: gaussians, images, trainer.model.options, torch.ones(3))
    assert torch.equal(found.most, expected.most)
    assert torch.equal(found.usual, expected.usual)
    assert found.most.shape == (50,)
    assert found.most.max() > 0.01


def test_points_are_triangulated_where_several_cameras_show_a_moment(tmp_path: Path) -> None:
    """As many Gaussians as points, of the room and not of a cube; without, random ones."""
    options = DynamicOptions(size=96, num_times=2, num_cameras=8, num_val=0, num_test=0, samples=1)
    root = write_dynamic_capture("room", tmp_path / "room", options)
    config = _dynamic(root, init=PointsInit(num_random=7))
    found = with_points(read_capture(config.data), config).points
    assert found is not None
    assert len(assemble(config).model.scene) == len(found.xyz) > 7
    without = config.model_copy(update={"init": PointsInit(num_random=7, triangulate=0)})
    assert len(assemble(without).model.scene) == 7


def test_no_points_are_triangulated_for_what_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And it goes on as if they had been."""
    options = DynamicOptions(size=96, num_times=2, num_cameras=8, num_val=0, num_test=0, samples=1)
    config = _dynamic(
        write_dynamic_capture("room", tmp_path / "room", options), init=PointsInit(num_random=7)
    )
    trainer = assemble(config)
    trainer.step()

    def refuse(*_: object) -> None:
        raise AssertionError("triangulated again")

    monkeypatch.setattr("dyngs.training.new_trainer.with_first_points", refuse)
    again = assemble(config, restored=True)
    again.restore(trainer.checkpoint())
    assert again.step().loss == trainer.step().loss
    tensors = trainer.checkpoint().tensors
    assert all(torch.equal(x, tensors[name]) for name, x in again.checkpoint().tensors.items())


def test_what_spoils_a_training_is_said_before_it(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once, to stderr; nothing where a run goes on."""
    root = _with_times(capture, tmp_path / "timed", [0.5, 0.0, 0.055, 0.5, 0.25])
    config = _dynamic(root)
    assemble(config)
    said = capsys.readouterr()
    assert said.err.count("dyngs: warning: times run from 0 to 0.5 and were scaled to [0, 1]") == 1
    assert said.out == ""
    assemble(config, restored=True)
    assert capsys.readouterr().err == ""


def test_a_still_blender_scene_begins_in_its_silhouettes_or_anywhere(capture: Path) -> None:
    config = Config(data=DataConfig(root=capture), init=PointsInit(num_random=7))
    found = with_points(read_capture(config.data), config).points
    assert found is not None
    assert len(found.xyz) == 7
    anywhere = config.model_copy(update={"init": RandomInit(num_random=7)})
    assert with_points(read_capture(config.data), anywhere).points is None


def test_the_coarse_phase_is_static_training(capture: Path, tmp_path: Path) -> None:
    """Until something moves, a dynamic run is a static one, byte by byte, on all views."""
    root = _with_times(capture, tmp_path / "timed", [0.0, 0.25, 0.5, 0.75, 1.0])
    static, dynamic = (
        assemble(_dynamic(root, model=m)) for m in (StaticModel(), DynamicModel(motion_from=1.0))
    )
    for _ in range(8):
        assert static.step().loss == dynamic.step().loss
    mine, others = (tensors_of(trainer.model.state()) for trainer in (static, dynamic))
    moments = [name for name in mine if name.startswith("exp_avg")]
    assert moments
    assert all(torch.equal(mine[name], others[name]) for name in moments)
