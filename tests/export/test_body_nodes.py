"""Bodies as animated nodes: the file and its animation show what the scene shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import MOVING_ROWS, sliding_nodes, write_moving_run
from scipy.spatial.transform import Rotation, Slerp

from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.deform.bodies.field import BodyField, BodyRest, bodies_of
from dyngs.deform.scene import DynamicScene
from dyngs.deform.windows import WindowedField
from dyngs.export.body_nodes import write_bodies
from dyngs.export.splat_files import Writing, splats_at
from dyngs.io.formats.formats import read_splats
from dyngs.io.gltf import GltfFile
from dyngs.runs.opened import Opened, open_run


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Opened:
    """Of five balls the second and the fourth are one body, which turns by 0.9 times half a turn
    and moves aside."""
    opened = open_run(write_moving_run(tmp_path_factory.mktemp("rolling")))
    angles = torch.linspace(-0.6, 1.1, 9) * np.pi / 2
    quats = torch.stack([angles.cos(), angles.sin() * 0.6, 0 * angles, angles.sin() * 0.8], dim=1)
    places = torch.stack(
        [torch.linspace(-1, 1, 9), torch.linspace(0, 0.5, 9) ** 2, torch.zeros(9)], dim=1
    )
    rest = BodyRest(
        torch.tensor([[0.1, 0.2, 0.0]]),
        torch.ones(1),
        torch.zeros(len(MOVING_ROWS), dtype=torch.long),
    )
    field = BodyField(sliding_nodes(), rest, {"places": places[None], "quats": quats[None]})
    assert isinstance(opened.scene, DynamicScene)
    return opened.showing(replace(opened.scene, field=WindowedField(field, len(MOVING_ROWS))))


TURNED = Writing((0.5, 0.5, 0.5, 0.5), "y")


@pytest.mark.parametrize("how", [Writing(), TURNED])
def test_the_animation_shows_the_scene_at_all_times(
    tmp_path: Path, rolling: Opened, how: Writing
) -> None:
    written = write_bodies(rolling, tmp_path / "a.glb", 0.25, how)
    whole = read_splats(written.path).gaussians
    file = GltfFile(written.path)
    rest, body = file.document.nodes
    assert (rest.name, body.name) == ("rest", "body 0")
    animation = file.document.animations[0]
    samples = {}
    for channel in animation.channels:
        assert channel.target.node == 1
        sampler = animation.samplers[channel.sampler]
        kind = {"translation": "VEC3", "rotation": "VEC4"}[channel.target.path]
        seconds = file.numbers(sampler.input, "SCALAR", np.float64)[:, 0]
        samples[channel.target.path] = file.numbers(sampler.output, kind, np.float64)
    assert seconds[-1] == pytest.approx(rolling.seconds)
    assert (samples["rotation"][1:] * samples["rotation"][:-1]).sum(1).min() > 0
    turns = Slerp(seconds, Rotation.from_quat(samples["rotation"]))
    own = [0, 1]  # the reader begins with the last node
    local = whole.means[own].numpy() - body.translation
    for time in (0.0, 0.25, 0.3, 0.875):
        now = time * rolling.seconds
        place = np.array([np.interp(now, seconds, samples["translation"][:, k]) for k in range(3)])
        expected = (
            splats_at(rolling, rolling.scene, time, how).gaussians.means[list(MOVING_ROWS)].numpy()
        )
        atol = 1e-5 if time != 0.3 else 0.02  # between two poses of the file
        np.testing.assert_allclose(turns(now).apply(local) + place, expected, atol=atol)


def test_without_the_animation_it_is_the_scene_at_that_time(
    tmp_path: Path, rolling: Opened
) -> None:
    written = write_bodies(rolling, tmp_path / "a.glb", 0.7)
    meant = written.splat.gaussians
    found = read_splats(written.path).gaussians
    order = [*MOVING_ROWS, 0, 2, 4]
    for name, x in found.tensors().items():
        torch.testing.assert_close(x, meant.tensors()[name][order], atol=1e-5, rtol=0)
    assert any("stand as at time 0.7" in note for note in written.notes)
    assert any("bodies: 1" in note for note in written.notes)


def test_a_body_without_a_rotation_stands(tmp_path: Path, rolling: Opened) -> None:
    """Splines of zeros, from a damaged or forged run."""
    assert isinstance(rolling.scene, DynamicScene)
    body = bodies_of(rolling.scene.field)
    assert body is not None
    blank = {name: torch.zeros_like(body.parameters[name].detach()) for name in ("places", "quats")}
    damaged = rolling.showing(
        replace(rolling.scene, field=BodyField(body.others, body.rest, blank))
    )
    assert len(read_splats(write_bodies(damaged, tmp_path / "a.glb", 0.0).path).gaussians) == 5


def test_a_run_without_bodies_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_moving_run(tmp_path)
    with pytest.raises(DyngsError, match="no body that turns"):
        write_bodies(open_run(run), tmp_path / "a.glb", 0.0)
    for wrong in (
        ["--out", "a.ply"],
        ["--times", "0:1:3"],
        ["--static"],
        ["--sh-degree", "1"],
        ["--format", "ply"],
    ):
        assert main(["export", str(run), "--bodies", *wrong]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.glob("**/*.glb"))
