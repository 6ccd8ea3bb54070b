"""A capture in millimetres, metres or kilometres trains to the same scene, which leaves in the unit
of the capture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scaled_captures import scaled_capture
from tiny_fields import write_tiny_capture
from tiny_people import NET
from tiny_stereo import STEREO

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.data.loader import ImageLoader
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.runs.checkpoint import latest_checkpoint, save_checkpoint

SHORT = ["train.steps=12", "run.threads=1", "init.num_random=200", "train.initial_downscale=1"]
PEOPLE = ["train.steps=3", "run.threads=1"]
SCENES = {
    "static": SHORT,
    "static_mcmc": [*SHORT, "strategy.max_gaussians=300"],
    "mip": SHORT,
    "blender": SHORT,
    "dynamic": [*SHORT, "model.pilot_runs=false", "strategy.max_gaussians=300"],
    "human": ["train.steps=8", "run.threads=1", "model.resolution=32", "data.train_cameras=[0]"],
    "ngp": ["train.steps=4", "run.threads=1", "model.sizes=tiny"],
    "nerf": ["train.steps=3", "run.threads=1", "model.sizes=tiny"],
    "bg_triangle": [
        "train.steps=6",
        "run.threads=1",
        "model.max_triangles=200",
        "model.gaussian_steps=20",
    ],
}
NETWORK_KEYS = {
    "human_predictor": {"kind": "human_predictor"} | NET.model_dump(),
    "gps": STEREO.model_dump(),
    "keypoint_nerf": {"kind": "keypoint_nerf", "source_views": 3},
    "eg_human_nerf": {"kind": "eg_human_nerf", "source_views": 3},
}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("captures")
    write_static_capture(root / "still", StaticOptions(size=24, num_train=8, num_test=2, samples=1))
    write_tiny_capture(root / "moving")
    person = HumanOptions(
        size=32, num_frames=3, num_pose_frames=1, num_cameras=4, num_test=1, samples=1
    )
    write_human_capture(root / "person", person)
    return root


def capture_for(preset: str, captures: Path) -> Path:
    return captures / {"human": "person", "dynamic": "moving"}.get(preset, "still")


def trained(preset: str, capture: Path, out: Path, *more: str) -> Path:
    overrides = [f"data.root={capture}", f"run.dir={out}", *SCENES[preset], *more]
    return train(dyngs.load_config(preset, overrides))


def assert_same_up_to_scale(one: Path, other: Path, scale: float) -> None:
    first = latest_checkpoint(one)
    second = latest_checkpoint(other)
    assert second.info.world_scale == scale * first.info.world_scale
    assert second.tensors.keys() == first.tensors.keys()
    for name, x in first.tensors.items():
        assert torch.equal(x, second.tensors[name]), name


@pytest.mark.parametrize("preset", SCENES)
def test_unit_of_a_power_of_two_trains_to_the_same_bytes(
    preset: str, captures: Path, tmp_path: Path
) -> None:
    capture = capture_for(preset, captures)
    one = trained(preset, capture, tmp_path / "one")
    for exponent in (-13, 10) if preset == "static" else (-13,):
        name = f"scaled{exponent}"
        scaled = scaled_capture(capture, tmp_path / name, 2.0**exponent)
        other = trained(preset, scaled, tmp_path / f"run_{name}")
        assert_same_up_to_scale(one, other, 2.0**exponent)


@pytest.mark.parametrize(
    ("scale", "offset"), [(1e-4, 0.0), (0.05, 0.0), (1e3, 0.0), (1.0, 5e6), (1e-3, 5e6)]
)
def test_other_units_and_places_train_to_the_same_images(
    scale: float, offset: float, captures: Path, tmp_path: Path
) -> None:
    """Rounding differs, and a float64 pose 1e6 extents away has ten digits left: images differ a
    little."""
    moved = scaled_capture(captures / "still", tmp_path / "moved", scale, (offset, -offset, 0.0))
    images = []
    for name, root in (("one", captures / "still"), ("other", moved)):
        scene = dyngs.load(trained("static", root, tmp_path / name))
        capture = dyngs.read_capture(root)
        cameras = ImageLoader(capture.splits["test"])[0].cameras
        images.append(scene.render(cameras).rgb)
    assert (images[0] - images[1]).abs().mean() < 0.01


def test_python_users_see_the_unit_of_the_files(captures: Path, tmp_path: Path) -> None:
    scale = 2.0**-10
    scaled = scaled_capture(captures / "still", tmp_path / "scaled", scale)
    scene = dyngs.load(trained("static", captures / "still", tmp_path / "one"))
    other = dyngs.load(trained("static", scaled, tmp_path / "other"))
    torch.testing.assert_close(other.at(0.0).means, scale * scene.at(0.0).means, rtol=0, atol=0)
    torch.testing.assert_close(other.at(0.0).scales, scale * scene.at(0.0).scales)
    torch.testing.assert_close(other.bounds, scale * scene.bounds, rtol=0, atol=0)
    options = [dyngs.RenderOptions(near=x.options.near, depth="expected") for x in (scene, other)]
    one_camera, other_camera = (
        ImageLoader(dyngs.read_capture(root).splits["test"])[0].cameras
        for root in (captures / "still", scaled)
    )
    wanted = scene.render(one_camera, options=options[0])
    found = other.render(other_camera, other.time_step(0.0), options=options[1])
    torch.testing.assert_close(found.rgb, wanted.rgb, rtol=0, atol=0)
    assert wanted.depth is not None
    assert found.depth is not None
    torch.testing.assert_close(found.depth, scale * wanted.depth, rtol=0, atol=0)


def test_exports_are_in_the_unit_of_the_capture(captures: Path, tmp_path: Path) -> None:
    scale = 2.0**-10
    scaled = scaled_capture(captures / "still", tmp_path / "scaled", scale)
    files = []
    frames = []
    poses = []
    meshes = []
    edited = []
    for name, root, unit in (("one", captures / "still", 1.0), ("other", scaled, scale)):
        run = trained("static", root, tmp_path / name)
        assert (
            main(["export", str(run), "--out", str(tmp_path / f"{name}.ply"), "--up", "keep"]) == 0
        )
        files.append(dyngs.load(tmp_path / f"{name}.ply").at(0.0))
        path = tmp_path / f"{name}.json"
        document = json.loads((root / "transforms_test.json").read_text())
        path.write_text(json.dumps(document | {"width": 24, "height": 24}))
        out = tmp_path / f"{name}_frames"
        assert main(["render", str(run), "--path", str(path), "--depth", "--out", str(out)]) == 0
        frames.append({file.name: file.read_bytes() for file in out.glob("*.png")})
        assert (
            main(
                [
                    "export",
                    str(run),
                    "--format",
                    "cameras",
                    "--out",
                    str(tmp_path / f"{name}_cameras.json"),
                ]
            )
            == 0
        )
        document = json.loads((tmp_path / f"{name}_cameras.json").read_text())
        mesh = tmp_path / f"{name}_mesh.ply"
        assert (
            main(["export", str(run), "--format", "mesh", "--cells", "32", "--out", str(mesh)]) == 0
        )
        meshes.append(trimesh.load(mesh, process=False).vertices / unit)
        out = tmp_path / f"{name}_twice"
        assert main(["edit", str(run), "--scale", "2", "--out", str(out)]) == 0
        assert (
            main(["export", str(out), "--out", str(tmp_path / f"{name}_twice.ply"), "--up", "keep"])
            == 0
        )
        edited.append(dyngs.load(tmp_path / f"{name}_twice.ply").at(0.0).means / unit)
        poses.append(np.array([x["transform_matrix"] for x in document["frames"]])[:, :3, 3] / unit)
    torch.testing.assert_close(files[1].means, scale * files[0].means, rtol=0, atol=0)
    torch.testing.assert_close(files[1].scales, scale * files[0].scales)
    assert frames[0] == frames[1]
    np.testing.assert_array_equal(poses[0], poses[1])
    np.testing.assert_allclose(meshes[0], meshes[1], rtol=1e-6)
    torch.testing.assert_close(edited[0], edited[1])
    torch.testing.assert_close(
        edited[0].square().sum(1), 4 * files[0].means.square().sum(1), rtol=1e-4, atol=0
    )


def test_run_of_an_earlier_version_is_evaluated_in_its_own_unit(
    captures: Path, tmp_path: Path
) -> None:
    """Such a run was trained in the unit of the files; its checkpoint does not name one."""
    scaled = scaled_capture(captures / "still", tmp_path / "scaled", 0.25)
    run = trained("static", scaled, tmp_path / "run")
    assert latest_checkpoint(run).info.world_scale != 1
    before = dyngs.load(run)
    psnr = evaluate_run(run).psnr
    checkpoint = latest_checkpoint(run)
    unit = checkpoint.info.world_scale
    gaussians = before.gaussians
    tensors = checkpoint.tensors | {
        "gaussians.means": gaussians.means,
        "gaussians.log_scales": gaussians.log_scales,
    }
    info = replace(checkpoint.info, world_scale=1.0, extent=unit * checkpoint.info.extent)
    save_checkpoint(run, replace(checkpoint, info=info, tensors=tensors), 1.0)
    assert evaluate_run(run).psnr == pytest.approx(psnr, abs=1e-3)
