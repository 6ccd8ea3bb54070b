"""Network weights in one file: predictions are preserved, and other files are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_stereo import STEREO, stereo_config

from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.predict.gps.stereo import GpsNetwork
from dyngs.io.tensor_file import FileKind, write_tensors
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.models.prediction import load_weights
from dyngs.runs.network_file import published_network, read_network, write_network

INFO = CheckpointInfo(7, 1.0, (0.0, 0.0, 0.0), "white", "classic")


@pytest.fixture
def config(tmp_path: Path) -> Config:
    return stereo_config(tmp_path, tmp_path / "run")


def checkpoint(scale: float = 1.0) -> Checkpoint:
    network = GpsNetwork(torch.Generator().manual_seed(0), STEREO)
    tensors = {f"model.network.{name}": scale * x for name, x in network.state_dict().items()}
    return Checkpoint(
        INFO, tensors | {"rng": torch.zeros(3), "optimizer.step.x": torch.tensor(1.0)}
    )


def test_weights_are_those_of_the_run_to_float16(config: Config, tmp_path: Path) -> None:
    """Next to the section ``model``; nothing of the training is in the file, nor a path of the
    run."""
    stored = checkpoint()
    path = write_network(tmp_path / "run", config, stored, tmp_path / "net.safetensors")
    found, weights = read_network(path)
    assert (found.model, weights.info) == (config.model, INFO)
    assert weights.tensors.keys() == {name for name in stored.tensors if name.startswith("model.")}
    for name, x in weights.tensors.items():
        torch.testing.assert_close(x, stored.tensors[name], rtol=1e-3, atol=1e-7)
    load_weights(GpsNetwork(torch.Generator(), found.model), weights)
    assert str(tmp_path).encode() not in path.read_bytes()
    assert path.stat().st_size < 2.2 * sum(x.numel() for x in weights.tensors.values()) + 20_000


def test_unsupported_networks_are_refused(config: Config, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="overflows float16"):
        write_network(tmp_path, config, checkpoint(1e6), tmp_path / "net.safetensors")
    with pytest.raises(DyngsError, match=r"is written as \.safetensors"):
        write_network(tmp_path, config, checkpoint(), tmp_path / "net.pt")
    own = config.model_copy(update={"model": HumanPredictorModel(body=tmp_path / "body.npz")})
    with pytest.raises(DyngsError, match=r"custom template \(model\.body\)"):
        write_network(tmp_path, own, checkpoint(), tmp_path / "net.safetensors")
    assert not list(tmp_path.glob("net*"))


def test_other_files_are_refused(config: Config, tmp_path: Path) -> None:
    """One-line errors for a damaged file, another kind, and a wrong header."""
    good = write_network(tmp_path, config, checkpoint(), tmp_path / "net.safetensors")
    bad = tmp_path / "bad.safetensors"
    half = good.read_bytes()[: good.stat().st_size // 2]
    cases: list[tuple[str, dict[str, object]]] = [
        ("dyngs avatar", {}),
        ("dyngs network", {"model": {"kind": "static"}}),
        ("dyngs network", {"model": {"kind": "gps", "person_px": "many"}}),
        ("dyngs network", {"model": {"kind": "human_predictor", "body": "/etc/passwd"}}),
    ]
    bad.write_bytes(half)
    messages = [_refusal(bad)]
    for key, changed in cases:
        header = {"step": 1, "extent": 1.0, "world_offset": (0, 0, 0), "background": "white"}
        write_tensors(
            bad, FileKind(key, "", 1), {}, header | {"rasterize_mode": "classic"} | changed
        )
        messages.append(_refusal(bad))
    assert "not the weights of a network" in messages[1]
    assert "model.kind=static" in messages[2]
    assert all(str(bad) in message and "\n" not in message for message in messages), messages


def _refusal(path: Path) -> str:
    with pytest.raises(DyngsError) as error:
        read_network(path)
    return str(error.value)


def test_weights_come_with_the_package() -> None:
    for name, kind in (("gps", "gps"), ("human_predictor", "human_predictor")):
        config, checkpoint = read_network(published_network(name))
        assert config.model.kind == kind
        assert checkpoint.tensors
    with pytest.raises(DyngsError, match="come with dyngs: gps and human_predictor; train others"):
        published_network("keypoint_nerf")
