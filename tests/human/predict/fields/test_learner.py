"""Networks that predict fields in training and at work: the same bytes, resuming, runs for other
commands, refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image
from refused import error_line
from stopped import stopped
from tiny_field_people import NETWORKS, field_config

from dyngs.api.predict import predict
from dyngs.api.train import train
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.human.predict.fields.prediction import PredictedField
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.training.prediction import network_trainer

KINDS = sorted(NETWORKS)


@pytest.fixture(scope="module", params=KINDS)
def run(
    request: pytest.FixtureRequest, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return train(
        field_config(request.param, folder, tmp_path_factory.mktemp("run") / request.param)
    )


def second_person(folder: Path) -> Path:
    return folder / "s0000" / "p000001"


def test_a_resumed_run_ends_with_the_same_bytes(run: Path, folder: Path, tmp_path: Path) -> None:
    config = field_config(run.name, folder, tmp_path / "parts")
    resumed = train(config, resume_from=stopped(config, 2))
    assert checkpoint_paths(resumed)[-1].read_bytes() == checkpoint_paths(run)[-1].read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_training_lowers_the_error(folder: Path, tmp_path: Path, kind: str) -> None:
    """On the same examples: 0.77 and 0.70 of it are left."""
    trainer = network_trainer(field_config(kind, folder, tmp_path / "run", steps=40))

    @torch.no_grad()
    def error() -> float:
        draws = (torch.Generator().manual_seed(i) for i in range(6))
        return sum(float(trainer.learner.example(0, 1, draw).loss) for draw in draws)

    before = error()
    for _ in range(30):
        trainer.step()
    assert error() < 0.9 * before


ALTERNATIVES = {"patch": 12, "supersampling": 2}


@pytest.mark.parametrize("kind", KINDS)
def test_other_keys_resume_predict_and_restore(folder: Path, tmp_path: Path, kind: str) -> None:
    whole = train(field_config(kind, folder, tmp_path / kind, ALTERNATIVES))
    config = field_config(kind, folder, tmp_path / "parts", ALTERNATIVES)
    resumed = train(config, resume_from=stopped(config, 2))
    assert checkpoint_paths(resumed)[-1].read_bytes() == checkpoint_paths(whole)[-1].read_bytes()
    made = predict(whole, second_person(folder), tmp_path / "two", 2)
    found = load_run(made.run_dir)
    assert isinstance(found.renderable, PredictedField)
    for name, value in ALTERNATIVES.items():
        if name in type(found.config.model).model_fields:
            assert getattr(found.config.model, name) == value
            assert getattr(found.renderable.network.keys, name) == value


def test_a_prediction_is_a_run(
    run: Path, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Drawn and measured like any other; not trained, and no Gaussians."""
    made = predict(run, second_person(folder), tmp_path / "three", 3)
    found = load_run(made.run_dir)
    assert isinstance(found.renderable, PredictedField)
    assert (found.config.model.kind, found.step, found.config.data.root) == (
        "predicted_field",
        0,
        second_person(folder),
    )
    assert (made.steps, made.num_gaussians, len(made.views)) == (0, 0, 3)
    again = predict(run, second_person(folder), tmp_path / "again", made.views)
    state = load_run(again.run_dir).renderable.state()
    assert all(
        torch.equal(x.tensor, state[name].tensor) for name, x in found.renderable.state().items()
    )
    report = evaluate_run(made.run_dir, "test", threads=1)
    assert report.psnr > 5
    assert report.notes == (), "nothing is left to train"
    assert "this needs a scene of Gaussians" in error_line(
        capsys, "export", str(made.run_dir), "--format", "ply"
    )
    assert "predicted fields cannot be trained" in error_line(
        capsys, "train", "--resume", str(made.run_dir)
    )
    assert "cannot be trained" in error_line(
        capsys, "train", f"data.root={second_person(folder)}", "model.kind=predicted_field"
    )


def test_unsuitable_prediction_inputs_are_refused(run: Path, folder: Path, tmp_path: Path) -> None:
    person = second_person(folder)
    out = tmp_path / "out"
    with pytest.raises(DyngsError, match="p000001: needs at least two views of one time step"):
        predict(run, person, out, 1)
    with pytest.raises(
        DyngsError, match=f"--steps 3: {run.name} is not trained on the images of one person"
    ):
        predict(run, person, out, 2, steps=3)
    twice = Path(shutil.copytree(person, tmp_path / "twice"))
    listed = json.loads((twice / "transforms_train.json").read_text())
    listed["frames"][2]["transform_matrix"] = listed["frames"][1]["transform_matrix"]
    (twice / "transforms_train.json").write_text(json.dumps(listed))
    with pytest.raises(DyngsError, match="from different directions"):
        predict(run, twice, out, tuple(Path(x["file_path"]).name for x in listed["frames"][1:3]))
    for file in (tmp_path / "twice").rglob("images/**/*.png"):
        Image.open(file).convert("RGB").save(file)
    with pytest.raises(DyngsError, match="twice: no silhouettes"):
        predict(run, twice, out, 2)
    half = Path(shutil.copytree(run, tmp_path / "half"))
    weights = checkpoint_paths(half)[-1]
    weights.write_bytes(weights.read_bytes()[: weights.stat().st_size // 2])
    with pytest.raises(DyngsError, match=weights.name):
        predict(half, person, out, 2)
    moving = tmp_path / "moving"
    shutil.copytree(person, moving)
    file = moving / "transforms_train.json"
    document = json.loads(file.read_text())
    document["frames"] = [x | {"time": float(i % 2)} for i, x in enumerate(document["frames"])]
    file.write_text(json.dumps(document))
    with pytest.raises(DyngsError, match="two views of one time step"):
        predict(run, moving, out, tuple(Path(x["file_path"]).name for x in document["frames"][1:3]))
    assert not out.exists()


def test_a_body_is_fitted_where_none_is_given(
    run: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By what `dyngs train human` does, too; without one nothing is guessed, and nothing
    written."""
    asked: list[Path] = []
    monkeypatch.setattr(
        "dyngs.human.predict.fields.prediction.ensure_fitted_body",
        lambda data, **_: (asked.append(data.root), data)[1],
    )
    person = Path(shutil.copytree(second_person(folder), tmp_path / "bare"))
    (person / "body_train.npz").unlink()
    with pytest.raises(DyngsError, match="bare: no body parameters"):
        predict(run, person, tmp_path / "out", 2)
    assert asked == [person]
    assert not (tmp_path / "out").exists()


def test_somebody_must_be_seen_from_three_sides(folder: Path, tmp_path: Path) -> None:
    person = Path(shutil.copytree(second_person(folder), tmp_path / "set" / "ann"))
    file = person / "transforms_train.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"frames": document["frames"][:2]}))
    with pytest.raises(
        DyngsError, match="ann: training needs a time step with three or more views"
    ):
        network_trainer(field_config("keypoint_nerf", tmp_path / "set", tmp_path))
