"""Avatar files: what is read back plays as the run does, also through the CLI; what is wrong with
one is one line."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from moving_scene import write_moving_run
from synthetic_bodies import model, write_npz
from torch import Tensor

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, DefaultStrategy, RunConfig, TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.human.avatar import avatar_file as avatar
from dyngs.human.avatar.avatar_file import read_avatar, write_avatar
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.keys import HumanModel
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.io.tensor_file import read_tensors, write_tensors
from dyngs.ops.quaternions import rotation_matrices
from dyngs.runs.checkpoint import LoadedRun, checkpoint_paths, load_run
from dyngs.runs.opened import open_run, open_scene


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "person"
    return write_human_capture(
        folder, HumanOptions(size=24, num_frames=2, num_pose_frames=0, num_cameras=2, num_test=0)
    )


def written(run: LoadedRun, path: Path) -> Path:
    return write_avatar(run.renderable, run.config.model, run.info, path)


def trained(capture: Path, folder: Path, **model: object) -> Path:
    return train(
        Config(
            data=DataConfig(root=capture),
            model=HumanModel(
                resolution=16,
                sh_degree=0,
                fit=False,
                **model,  # type: ignore[arg-type]
            ),
            strategy=DefaultStrategy(grow=False),
            train=TrainConfig(steps=4),
            run=RunConfig(dir=folder, threads=1),
        )
    )


@pytest.fixture(scope="module")
def run_dir(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(capture, tmp_path_factory.mktemp("run"), light=True)


@pytest.fixture
def file(run_dir: Path, tmp_path: Path) -> Path:
    return written(load_run(run_dir), tmp_path / "ann.safetensors")


@pytest.fixture
def motion(tmp_path: Path) -> Path:
    poses = 0.3 * torch.randn(3, 55, 3, generator=torch.Generator().manual_seed(0))
    write_amass(
        Motion(poses, torch.zeros(3, 3), torch.zeros(10), 10.0, torch.ones(3)),
        tmp_path / "walk.npz",
    )
    return tmp_path / "walk.npz"


def test_the_file_plays_as_the_run(run_dir: Path, file: Path, motion: Path) -> None:
    run = open_run(run_dir)
    read = open_scene(file)
    for one, other in ((run.play_motion(motion), read.play_motion(motion)), (run.at_rest(), read)):
        for time in (0.0, 0.7, 1.0):
            wanted = one.scene.at(time).tensors()
            found = other.scene.at(time).tensors()
            for name, x in found.items():
                if name != "quats":
                    # axes of nearly equal length turn by more than their shape shows
                    torch.testing.assert_close(x, wanted[name], rtol=0, atol=1e-5)
            shapes = [
                rotation_matrices(x["quats"]) * x["log_scales"].exp()[:, None]
                for x in (found, wanted)
            ]
            a, b = (x @ x.mT for x in shapes)
            assert float((a - b).abs().amax((1, 2)).div(b.abs().amax((1, 2))).max()) < 1e-4
    assert isinstance(read.scene, HumanScene)
    assert isinstance(run.scene, HumanScene)
    assert read.scene.light is not None
    assert read.scene.light.factors.any()
    assert asdict(read.info) == asdict(run.info)
    assert torch.equal(read.scene.anchors.uv, run.scene.anchors.uv)
    assert written(run, file.with_name("again.safetensors")).read_bytes() == file.read_bytes()


def test_blend_shapes_go_along_and_the_template_is_looked_for_beside_the_file(
    capture: Path, tmp_path: Path, motion: Path
) -> None:
    body = write_npz(tmp_path / "bodies.npz", model("smplx"))
    run = open_run(trained(capture, tmp_path / "run", body=body))
    file = written(run, tmp_path / "elsewhere" / "ann.safetensors")
    with pytest.raises(DyngsError, match=r"elsewhere/bodies\.npz: cannot be read"):
        open_scene(file).play_motion(motion)
    (tmp_path / "elsewhere" / "bodies.npz").write_bytes(body.read_bytes())
    one, other = (x.play_motion(motion).scene for x in (run, open_scene(file)))
    assert isinstance(other, HumanScene)
    assert other.shapes is not None
    torch.testing.assert_close(other.at(0.4).means, one.at(0.4).means, rtol=0, atol=1e-5)
    write_npz(tmp_path / "elsewhere" / "bodies.npz", model("smplx", seed=1))
    with pytest.raises(DyngsError, match=r"ann\.safetensors: needs its own template 'bodies\.npz'"):
        read_avatar(file)


def refusal(path: Path) -> str:
    with pytest.raises(DyngsError) as caught:
        read_avatar(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_files_that_are_missing_cut_altered_or_foreign(run_dir: Path, file: Path) -> None:
    whole = file.read_bytes()
    for fraction in (0.0, 0.001, 0.5, 0.999):
        file.write_bytes(whole[: int(fraction * len(whole))])
        assert "cannot be read as an avatar" in refusal(file)
    for where in (0.3, 0.99):
        at = int(where * len(whole))
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert (
            "its checksum differs; export it again with `dyngs export RUN --format avatar`"
            in refusal(file)
        )
    assert "not an avatar of dyngs" in refusal(checkpoint_paths(run_dir)[-1])
    assert "cannot be read as an avatar" in refusal(file.with_name("none.safetensors"))


Change = Callable[[dict[str, Tensor]], object]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x: x.pop("anchors.face"), "anchors.face is missing"),
        (lambda x: x.pop("gaussians.means"), "means is missing"),
        (
            lambda x: x.update({"gaussians.quats": torch.zeros(3, 4)}),
            "quats must be",
        ),
        (
            lambda x: x.update({"anchors.joints": x["anchors.joints"].float()}),
            "'anchors.joints' is float32",
        ),
        (lambda x: x["gaussians.means"].fill_(torch.nan), "'means' has NaN"),
        (lambda x: x["anchors.joints"].fill_(55), "'anchors.joints' has indices outside"),
        (lambda x: x["anchors.weights"].neg_(), "negative or sum to 0"),
        (lambda x: x["skeleton.parents"].fill_(7), "joint 0 has parent 7"),
        (lambda x: x["reference.scale"].zero_(), "'clip.scale' must be above 0"),
        (
            lambda x: x.update({"shapes.directions": torch.zeros(486, 3)}),
            "'shapes.directions' is float32",
        ),
    ],
)
def test_a_proper_checksum_over_improper_contents(file: Path, change: Change, words: str) -> None:
    header, tensors = read_tensors(file, avatar._KIND, "")
    change(tensors)
    write_tensors(file, avatar._KIND, tensors, header)
    message = refusal(file)
    assert re.search(words, message)
    assert "not a valid avatar" in message


def test_only_people_are_exported(tmp_path: Path, run_dir: Path) -> None:
    run = load_run(write_moving_run(tmp_path / "run"))
    with pytest.raises(DyngsError, match=r"--format avatar needs a run with model.kind=human"):
        written(run, tmp_path / "a.safetensors")
    with pytest.raises(
        DyngsError, match=r"a\.npz: the name of an avatar file must end in \.safetensors"
    ):
        written(load_run(run_dir), tmp_path / "a.npz")
