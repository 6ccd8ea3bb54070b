"""Files of ``torch.save``: tensors come back, nothing else does, and nothing runs."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dyngs.errors import DyngsError
from dyngs.files.torch_files import StoredTensor, TorchFile


def test_tensors_of_all_layouts_come_back(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    whole = torch.randn(6, 5, generator=generator)
    stored: dict[str, Any] = {"part": whole[2:5, 1:], "turned": whole.T, "double": whole.double(), "half": whole.half()}
    stored |= {"scalar": torch.tensor(3.5), "empty": torch.zeros(4, 0, 3), "parameter": torch.nn.Parameter(whole)}
    torch.save(stored | {"step": 7, "nested": [{"lr": 0.5}, None]}, tmp_path / "a.pt")
    file = TorchFile(tmp_path / "a.pt")
    contents: Any = file.contents
    assert (contents["step"], contents["nested"]) == (7, [{"lr": 0.5}, None])
    for name, tensor in stored.items():
        np.testing.assert_array_equal(file.numbers(contents[name]), tensor.detach().float().numpy())


def test_integers_are_named_but_not_read(tmp_path: Path) -> None:
    torch.save({"counts": torch.arange(3)}, tmp_path / "a.pt")
    file = TorchFile(tmp_path / "a.pt")
    contents: Any = file.contents
    with pytest.raises(DyngsError, match=r"a torch\.LongStorage, not of floats"):
        file.numbers(contents["counts"])


class Attack:
    """Pickled, it is a call of ``os.system``."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (f"touch {self.mark}",)


@pytest.mark.parametrize("place", ["beside", "within"])
def test_code_in_a_file_is_not_run(place: str, tmp_path: Path) -> None:
    mark = tmp_path / "attacked"
    attack = Attack(mark)
    torch.save({"x": torch.ones(2), "y": attack if place == "beside" else {"z": [attack]}}, tmp_path / "a.pt")
    with pytest.raises(DyngsError, match=r"a\.pt: cannot be read \(ValueError: it holds '\w+\.system'"):
        TorchFile(tmp_path / "a.pt")
    assert not mark.exists()


def with_pickle(path: Path, content: bytes, *members: tuple[str, bytes], how: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", how) as archive:
        archive.writestr("a/data.pkl", content)
        for name, data in members:
            archive.writestr(f"a/data/{name}", data)
    return path


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save({"x": torch.ones(200)}, path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DyngsError, match=r"a\.pt: is no file of torch\.save"):
        TorchFile(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/other", b"")
    for broken in (
        path,
        with_pickle(path, b"\x80\x02X"),
        with_pickle(path, pickle.dumps({}), how=zipfile.ZIP_DEFLATED),
    ):
        with pytest.raises(DyngsError, match=r"a\.pt: cannot be read"):
            TorchFile(broken)


def test_tensors_beyond_their_numbers_are_refused(tmp_path: Path) -> None:
    path = with_pickle(tmp_path / "a.pt", pickle.dumps({}), ("0", bytes(64)))
    file = TorchFile(path)
    good = StoredTensor("0", "torch.FloatStorage", 0, (4, 4), (4, 1))
    assert file.numbers(good).shape == (4, 4)
    for shape, strides, first in (
        ((1 << 40, 4), (0, 1), 0),
        ((4, 4), (4, 1), 1),
        ((4, 4), (40, 1), 0),
        ((4, 4), (4, -1), 0),
    ):
        with pytest.raises(DyngsError, match=r"a\.pt: cannot be read"):
            file.numbers(StoredTensor("0", "torch.FloatStorage", first, shape, strides))
    with pytest.raises(DyngsError, match=r"a\.pt: cannot be read"):
        file.numbers(StoredTensor("../0", "torch.FloatStorage", 0, (4, 4), (4, 1)))
