"""The shape of a known person: where it is found, what it does to the template, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.errors import DyngsError
from dyngs.files.write import write_text
from dyngs.human.fit.known_person import known_shape, shape_of, with_shape
from dyngs.human.template.load import default_template


def fitted(folder: Path, kind: str = "anny") -> Path:
    folder.mkdir()
    betas = np.linspace(-1, 1, default_template().num_shapes)
    parts = {"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3)), "betas": betas, "surface_model_type": kind}
    np.savez(folder / "body_train.npz", **parts)  # pyright: ignore[reportArgumentType]
    return folder


def test_the_template_gets_the_shape(tmp_path: Path) -> None:
    body = default_template()
    known = known_shape(fitted(tmp_path / "a"))
    shaped, betas = with_shape(body, known), shape_of(body, known)
    assert body.joint_shape_dirs is not None
    assert torch.allclose(shaped.joints, body.joints + body.joint_shape_dirs @ betas, atol=1e-5)
    assert betas[-1] == 1
    assert shaped.num_shapes == body.num_shapes


def test_a_run_names_the_capture_it_was_trained_on(tmp_path: Path) -> None:
    folder, run = fitted(tmp_path / "a"), tmp_path / "run"
    run.mkdir()
    write_text(run / "config.yaml", f"data:\n  root: {folder}\nmodel:\n  kind: human\n")
    assert known_shape(run).betas[-1] == 1


def test_others_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no fitted person there"):
        known_shape(tmp_path)
    with pytest.raises(DyngsError, match="of another template"):
        known_shape(fitted(tmp_path / "b", "smplx"))
