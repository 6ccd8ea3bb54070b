"""Which template a model asks for, and whose shape it takes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from motion_files import tiny_body
from synthetic_bodies import model, write_npz

from dyngs.config import HumanModel
from dyngs.errors import DyngsError
from dyngs.human.template.body import apply_shape
from dyngs.human.template.load import default_template, load_template, rest_shape


def test_the_free_template_is_the_default() -> None:
    assert torch.equal(load_template(HumanModel()).vertices, default_template().vertices)


def test_a_body_file_is_read(tmp_path: Path) -> None:
    found = load_template(HumanModel(body=write_npz(tmp_path / "x.npz", model("smplx"))))
    assert found.name == "smplx"


def test_texture_coordinates_alone_are_an_error() -> None:
    with pytest.raises(DyngsError, match=r"goes with model\.body"):
        load_template(HumanModel(uv=Path("smplx_uv.obj")))


def test_shape_parameters_that_a_template_lacks_are_left_out() -> None:
    body = tiny_body(shapes=2)
    betas = torch.tensor([0.5, -1.0, 3.0])
    vertices, joints = rest_shape(body, betas)
    wanted = apply_shape(body, betas[:2])
    assert torch.equal(vertices, wanted[0])
    assert torch.equal(joints, wanted[1])
    plain = default_template()
    assert torch.equal(rest_shape(plain, betas)[0], plain.vertices)
