"""Which template a model asks for, and whose shape it takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from motion_files import tiny_body
from synthetic_bodies import model, write_npz

from dyngs.config import HumanModel
from dyngs.data.capture import BodyFrames, ShapeSpace
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


def given(betas: torch.Tensor, shape_space: ShapeSpace) -> BodyFrames:
    row = np.zeros((1, 3))
    return BodyFrames((0,), np.zeros((1, 55, 3)), row, betas.numpy(), np.ones(1), shape_space=shape_space)


def test_shape_parameters_that_a_template_lacks_are_left_out() -> None:
    body = tiny_body(shapes=2)
    betas = torch.tensor([0.5, -1.0, 3.0])
    vertices, joints = rest_shape(body, given(betas, "smpl"))
    wanted = apply_shape(body, betas[:2])
    assert torch.equal(vertices, wanted[0])
    assert torch.equal(joints, wanted[1])


def test_shape_parameters_count_in_their_own_shape_space_only() -> None:
    betas = torch.tensor([0.5, -1.0, 3.0])
    free, other = default_template(), tiny_body(shapes=2)
    assert torch.equal(rest_shape(free, given(betas, "smpl"))[0], free.vertices)
    assert torch.equal(rest_shape(other, given(betas, "anny"))[1], other.joints)
    assert torch.equal(rest_shape(free, given(betas, "anny"))[1], apply_shape(free, betas)[1])
