"""The stereo network in training and at work: the same bytes, exact resuming, scenes for other
commands, refusals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from camera_rings import UP, cameras_at
from stopped import stopped
from tiny_stereo import RECURRENT, stereo_config, stereo_people

from dyngs.api.predict import predict
from dyngs.api.train import train
from dyngs.config import DataConfig
from dyngs.config.io import load_resolved
from dyngs.core.conventions import ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr
from dyngs.data.geometry import look_at
from dyngs.data.loader import ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.gaussians.static_scene import StaticScene
from dyngs.human.predict.gps.rectification import neighbour_pairs
from dyngs.human.predict.gps.stereo import GpsNetwork, RecurrentNetwork, learner, predictor
from dyngs.human.predict.kind import GpsModel
from dyngs.human.synthetic.capture import PeopleOptions, write_people
from dyngs.models.prediction import Predictor, load_weights
from dyngs.runs.checkpoint import checkpoint_paths, load_checkpoint, load_run
from dyngs.runs.network_file import read_network, write_network
from dyngs.training.prediction import network_trainer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stereo_people(tmp_path_factory.mktemp("people") / "set")


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(stereo_config(folder, tmp_path_factory.mktemp("run") / "net"))


def read_captured_person(folder: Path) -> Path:
    return list_captures(DataConfig(root=folder))[0].root


def test_a_resumed_run_ends_with_the_same_bytes(folder: Path, run: Path, tmp_path: Path) -> None:
    """Resume between the two stages, when the optimiser has no moments of the second stage yet."""
    middle, last = checkpoint_paths(run)
    config = stereo_config(folder, tmp_path / "parts")
    resumed = train(config, resume_from=stopped(config, 2))
    assert checkpoint_paths(resumed)[-1].read_bytes() == last.read_bytes()
    before = load_checkpoint(middle)
    after = load_checkpoint(last)
    assert not any(name.startswith("optimizer.exp_avg.heads") for name in before.tensors)
    assert any(name.startswith("optimizer.exp_avg.heads") for name in after.tensors)
    assert not torch.equal(
        before.tensors["model.network.heads.bias"], after.tensors["model.network.heads.bias"]
    )


def test_recurrent_matching_is_trained_resumed_stored_and_used(
    folder: Path, tmp_path: Path
) -> None:
    """Errors are logged in both stages; resumed within either the end has the same bytes; a file
    of weights predicts what its run does, with the updates of the run."""
    whole = train(stereo_config(folder, tmp_path / "whole", RECURRENT, save_every=1, log_every=1))
    lines = [json.loads(line) for line in (whole / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2, 3, 4]
    assert all(0 < line["end_point_error_px"] < 100 for line in lines)
    last = checkpoint_paths(whole)[-1]
    for step in (1, 3):
        config = stereo_config(folder, tmp_path / f"parts{step}", RECURRENT, save_every=1)
        resumed = train(config, resume_from=stopped(config, step))
        assert checkpoint_paths(resumed)[-1].read_bytes() == last.read_bytes()
    file = write_network(
        whole, load_resolved(whole), load_checkpoint(last), tmp_path / "net.safetensors"
    )
    person = read_captured_person(folder)
    names = ("f000_c03.png", "f000_c05.png")
    scenes = []
    for network in (whole, file):
        made = predict(network, person, tmp_path / f"{network.stem}_scene", names)
        scenes.append(load_run(made.run_dir).scene)
    torch.testing.assert_close(
        scenes[0].gaussians.means, scenes[1].gaussians.means, atol=1e-3, rtol=0
    )
    config, checkpoint = read_network(file)
    assert isinstance(config.model, GpsModel)
    assert config.model == RECURRENT
    network = GpsNetwork(torch.Generator(), config.model)
    load_weights(network, checkpoint)
    assert isinstance(network.stereo, RecurrentNetwork)
    assert network.stereo.updates == 2


def test_weights_of_the_other_matching_are_refused(run: Path) -> None:
    with pytest.raises(DyngsError, match="is not of this network; was its config changed"):
        load_weights(
            GpsNetwork(torch.Generator(), RECURRENT), load_checkpoint(checkpoint_paths(run)[-1])
        )


def test_training_lowers_the_errors(folder: Path, tmp_path: Path) -> None:
    """Of depth in the first half, of images in the second, on the same examples."""
    trainer = network_trainer(stereo_config(folder, tmp_path / "run", steps=80))

    @torch.no_grad()
    def error(step: int) -> float:
        draws = (torch.Generator().manual_seed(i) for i in range(6))
        return sum(float(trainer.learner.example(0, step, draw).loss) for draw in draws)

    depth = error(1)
    for _ in range(32):
        trainer.step()
    image = error(80)
    assert error(1) < 0.9 * depth
    for _ in range(48):
        trainer.step()
    assert error(80) < 0.9 * image
    assert trainer.num_gaussians > 200


def test_a_prediction_is_a_run_of_a_static_scene(run: Path, folder: Path, tmp_path: Path) -> None:
    """Which is drawn, measured and trained on like any other; the same views give the same
    bytes."""
    person = read_captured_person(folder)
    made = predict(run, person, tmp_path / "two", ("f000_c03.png", "f000_c05.png"))
    found = load_run(made.run_dir)
    assert isinstance(found.scene, StaticScene)
    assert (found.config.model.kind, found.step, found.config.data.root) == ("static", 0, person)
    assert len(found.scene) == made.num_gaussians > 200
    assert (made.steps, len(made.views)) == (0, 2)
    again = predict(run, person, tmp_path / "again", ("f000_c05.png", "f000_c03.png"))
    assert torch.equal(load_run(again.run_dir).scene.gaussians.means, found.scene.gaussians.means)
    report = evaluate_run(made.run_dir, "train", threads=1)
    assert report.psnr > 5
    longer = found.config.model_copy(
        update={"train": found.config.train.model_copy(update={"steps": 2})}
    )
    assert load_run(train(longer, resume_from=made.run_dir)).step == 2


def test_a_ring_is_seen_from_all_round(run: Path, folder: Path, tmp_path: Path) -> None:
    """Between two views the surface of these two is drawn, as if there were no others; so it is
    after storing."""
    person = read_captured_person(folder)
    all_round = predict(run, person, tmp_path / "12", 12)
    assert len(all_round.views) == 12
    found = load_run(all_round.run_dir).scene
    assert isinstance(found, StaticScene)
    assert found.sides is not None
    assert len(found.sides.directions) == 12
    side = 3
    views = [
        v
        for x in read_capture(DataConfig(root=person)).splits.values()
        for v in x
        if v.name in all_round.views
    ]
    pair = neighbour_pairs(
        "p", views, [[v.name for v in views].index(name) for name in all_round.views]
    )[side]
    names = tuple(views[i].name for i in pair)
    two = load_run(predict(run, person, tmp_path / "2", names).run_dir).scene
    eye = (2 * found.sides.directions[side] + found.sides.center).numpy()
    middle = found.sides.center.numpy()
    between = cameras_at(look_at(eye, middle, UP)[None]).to(dtype=torch.float32)
    assert float(two.render(between).alpha.mean()) > 0.01
    torch.testing.assert_close(found.render(between).rgb, two.render(between).rgb)


def changed(
    person: Path, out: Path, change: Callable[[list[dict[str, Any]]], list[dict[str, Any]]]
) -> Path:
    """A copy of the capture with other frames."""
    shutil.copytree(person, out)
    whole = json.loads((out / "transforms_train.json").read_text())
    (out / "transforms_train.json").write_text(
        json.dumps(whole | {"frames": change(whole["frames"])})
    )
    return out


def test_one_moment_of_several_is_what_its_run_is_trained_on(
    run: Path, folder: Path, tmp_path: Path
) -> None:
    person = changed(
        read_captured_person(folder),
        tmp_path / "moving",
        lambda frames: [
            frame | {"frame": i % 2, "time": float(i % 2)} for i, frame in enumerate(frames)
        ],
    )
    (person / "body_train.npz").unlink()
    data = DataConfig(root=person)
    found: Predictor = predictor(
        stereo_config(folder, tmp_path),
        load_checkpoint(checkpoint_paths(run)[-1]),
        data,
        [].append,
        ignore_progress,
    )
    later = [i for i, view in enumerate(found.views) if view.frame == 1][:2]
    assert found.run_config(later).data.frames == "1:2"
    made = predict(run, person, tmp_path / "out", tuple(found.views[i].name for i in later))
    assert load_run(made.run_dir).scene.is_static
    assert evaluate_run(made.run_dir, "train", threads=1).num_views == 10, (
        "two of twelve are held out for testing"
    )


def without_depth(frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: x for key, x in frame.items() if key != "depth_file_path"} for frame in frames]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda frames: frames[::3],
            "p: no view lies between two others at most 50 degrees apart",
        ),
        (without_depth, "p: no depth maps, which training needs"),
    ],
)
def test_unsuitable_training_data_is_refused(
    folder: Path, tmp_path: Path, change: Any, message: str
) -> None:
    changed(read_captured_person(folder), tmp_path / "set" / "p", change)
    with pytest.raises(DyngsError, match=message):
        learner(stereo_config(tmp_path / "set", tmp_path), torch.Generator())


def test_published_weights_predict_somebody_unknown(tmp_path: Path) -> None:
    """In the box of the person on white, from the middle between two views; 26.3 dB when this was
    written."""
    person = list_captures(
        DataConfig(root=write_people(tmp_path / "set", PeopleOptions(1, 192, seed=7)))
    )[0].root
    made = predict(Path("gps"), person, tmp_path / "two", ("f000_c03.png", "f000_c05.png"))
    views = read_capture(DataConfig(root=person)).splits["train"]
    image = ImageLoader(
        tuple(view for view in views if "c04" in view.name), DataConfig(root=person)
    )[0]
    drawn = load_run(made.run_dir).scene.render(image.cameras).rgb[0]
    truth = image.composite(torch.ones(3))
    assert image.alpha is not None
    rows, columns = (
        slice(int(x.min()), int(x.max()) + 1) for x in image.alpha.nonzero(as_tuple=True)
    )
    found = psnr(drawn[rows, columns].clamp(0, 1), truth[rows, columns])
    assert found > 24.5
