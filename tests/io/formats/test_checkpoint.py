"""Checkpoints as nerfstudio's splatfacto and gsplat's examples write them."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from splat_scenes import cloud

from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.formats import format_for_path, read_splats


def parameters(scene: Gaussians, of_nerfstudio: bool) -> torch.nn.ParameterDict:
    rest = scene.sh[:, 1:]
    found = {"means": scene.means, "scales": scene.log_scales, "quats": 3 * scene.quats}
    if of_nerfstudio:
        found |= {
            "opacities": scene.logit_opacities[:, None],
            "features_dc": scene.sh[:, 0],
            "features_rest": rest,
        }
    else:
        found |= {"opacities": scene.logit_opacities, "sh0": scene.sh[:, :1], "shN": rest}
    return torch.nn.ParameterDict(
        {name: torch.nn.Parameter(tensor.clone()) for name, tensor in found.items()}
    )


def nerfstudio(scene: Gaussians) -> dict[str, Any]:
    """Return what nerfstudio's trainer saves after a step."""
    pipeline = torch.nn.Module()
    pipeline._model = torch.nn.Module()
    own = pipeline._model.gauss_params = parameters(scene, of_nerfstudio=True)
    pipeline._model.register_buffer("device_indicator", torch.zeros(0))
    optimizer = torch.optim.Adam([own["means"]], lr=1e-3, eps=1e-15)
    own["means"].sum().backward()
    optimizer.step()
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda _: 1.0)
    return {
        "step": 29999,
        "pipeline": pipeline.state_dict(),
        "optimizers": {"means": optimizer.state_dict()},
        "schedulers": {"means": scheduler.state_dict()},
        "scalers": torch.amp.GradScaler("cpu").state_dict(),
    }


def same(found: Gaussians, wanted: Gaussians) -> None:
    for name, tensor in wanted.tensors().items():
        torch.testing.assert_close(found.tensors()[name], tensor, rtol=0, atol=2e-6, msg=name)


@pytest.mark.parametrize("degree", [0, 3])
def test_gsplat(degree: int, tmp_path: Path) -> None:
    scene = cloud(50, degree)
    torch.save(
        {"step": 6999, "splats": parameters(scene, False).state_dict()},
        tmp_path / "ckpt_6999_rank0.pt",
    )
    back = read_splats(tmp_path / "ckpt_6999_rank0.pt")
    same(back.gaussians, scene)
    assert back.up == "z"
    assert "z is assumed to be up" in back.notes[0]


def test_nerfstudio(tmp_path: Path) -> None:
    state = nerfstudio(cloud(50, 3))
    torch.save(state, tmp_path / "step-000029999.ckpt")
    moved = state["pipeline"]["_model.gauss_params.means"]
    same(read_splats(tmp_path / "step-000029999.ckpt").gaussians, cloud(50, 3).replace(means=moved))


class Attack:
    """Pickled, it is a call of ``os.system``."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (f"touch {self.mark}",)


@pytest.mark.parametrize("place", ["beside", "within"])
def test_code_in_a_file_is_not_run(place: str, tmp_path: Path) -> None:
    attack = Attack(tmp_path / "attacked")
    whole = parameters(cloud(5, 1), False).state_dict()
    torch.save(
        {"splats": whole, "x": attack if place == "beside" else {"z": [attack]}}, tmp_path / "a.pt"
    )
    with pytest.raises(
        DyngsError,
        match=r"a\.pt: damaged, or contains Python objects, which are not loaded; export",
    ):
        read_splats(tmp_path / "a.pt")
    assert not (tmp_path / "attacked").exists()


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"splats": parameters(cloud(50, 1), False).state_dict()}, path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DyngsError, match=r"a\.pt: not a torch\.save file"):
        read_splats(path)
    for content in (b"\x80\x02X", b"", pickle.dumps(torch.ones)):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a/data.pkl", content)
        with pytest.raises(DyngsError, match=r"a\.pt: (damaged|no Gaussians)"):
            read_splats(path)


def test_other_checkpoints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    whole = parameters(cloud(5, 1), False).state_dict()
    short = {**whole, "quats": whole["quats"][:4]}
    odd = {**whole, "shN": torch.zeros(5, 4, 3)}
    for state in (
        {"state_dict": {"weight": torch.ones(3)}},
        [1, 2],
        {"splats": {**whole, "other.means": whole["means"]}},
    ):
        torch.save(state, path)
        with pytest.raises(
            DyngsError, match=r"a\.pt: no Gaussians of .* `ns-export gaussian-splat`"
        ):
            read_splats(path)
    for state, problem in (
        (short, "cannot be read"),
        (odd, "5 SH coefficients do not match any supported degree"),
    ):
        torch.save({"splats": state}, path)
        with pytest.raises(DyngsError, match=problem):
            read_splats(path)
    with pytest.raises(DyngsError, match="unknown file type"):
        format_for_path(path)
