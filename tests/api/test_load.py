"""Every file that dyngs writes is loaded as a scene that draws the same images."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import dyngs
from dyngs.api.load import load
from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import train
from dyngs.export.splat_files import write_run_splats
from dyngs.human.avatar.avatar_file import write_avatar
from dyngs.runs.checkpoint import load_run
from dyngs.runs.opened import open_run

pytestmark = pytest.mark.usefixtures("one_thread")


def trained(capture: Path, out: Path, *more: str) -> Path:
    words = [
        f"data.root={capture}",
        f"run.dir={out}",
        "train.steps=3",
        "run.threads=1",
        "init.num_random=60",
        *more,
    ]
    return train(dyngs.load_config(None, words))


def camera(size: int = 24) -> dyngs.Cameras:
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    intrinsics = torch.tensor(
        [[float(size), 0.0, size / 2], [0.0, float(size), size / 2], [0.0, 0.0, 1.0]]
    )
    return dyngs.Cameras(pose[None], intrinsics[None], size, size)


def test_a_run_its_ply_and_its_small_file_show_the_same(still: Path, tmp_path: Path) -> None:
    run = trained(still, tmp_path / "run", "init.kind=random")
    wanted = load(run).render(camera(), background=torch.zeros(3)).rgb
    assert float(wanted.detach().abs().max()) > 0.05  # something is seen
    ply = write_run_splats(open_run(run), tmp_path / "a.ply").path
    # quats normalised
    torch.testing.assert_close(load(ply).render(camera()).rgb, wanted, rtol=1e-4, atol=1e-5)
    small = write_scene_file(run, tmp_path / "small").path
    for path in (small, small.parent, str(small)):
        shown = load(path).render(camera(), background=torch.zeros(3)).rgb
        # rounded so that PSNR falls by 0.025 dB
        assert float((shown - wanted).square().mean().sqrt()) < 0.02


def test_the_background_is_that_of_training(still: Path, tmp_path: Path) -> None:
    run = trained(still, tmp_path / "run", "init.kind=random", "data.background=white")
    scene = load(run)
    torch.testing.assert_close(
        scene.render(camera()).rgb, scene.render(camera(), background=torch.ones(3)).rgb
    )
    assert not torch.equal(
        scene.render(camera()).rgb, scene.render(camera(), background=torch.zeros(3)).rgb
    )


def test_an_avatar_is_a_scene(person: Path, tmp_path: Path) -> None:
    words = [
        f"data.root={person}",
        "train.steps=2",
        "model.resolution=16",
        "model.fit=false",
        "run.threads=1",
    ]
    run = train(dyngs.load_config("human", [*words, f"run.dir={tmp_path / 'run'}"]))
    loaded = load_run(run)
    file = tmp_path / "a.safetensors"
    scene = load(write_avatar(loaded.renderable, loaded.config.model, loaded.info, file))
    assert len(scene) == len(load(run))
    assert scene.is_static


@pytest.mark.parametrize("name", ["nothing", "words.txt", "b.safetensors"])
def test_non_scenes_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    if name != "nothing":
        (tmp_path / name).write_text("words")
    with pytest.raises(dyngs.DyngsError, match=name) as refused:
        load(tmp_path / name)
    assert "\n" not in str(refused.value)
