"""Which template a model asks for, and whose shape it takes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from motion_files import tiny_body
from synthetic_bodies import model, write_npz

from dyngs.config import HumanModel
from dyngs.errors import DyngsError
from dyngs.human.template.body import default_body, shaped
from dyngs.human.template.person import rest_shape, template


def test_the_free_template_is_the_default() -> None:
    assert torch.equal(template(HumanModel()).vertices, default_body().vertices)


def test_a_body_file_is_read(tmp_path: Path) -> None:
    found = template(HumanModel(body=write_npz(tmp_path / "x.npz", model("smplx"))))
    assert found.name == "smplx"


def test_texture_coordinates_alone_are_an_error() -> None:
    with pytest.raises(DyngsError, match=r"goes with model\.body"):
        template(HumanModel(uv=Path("smplx_uv.obj")))


def test_shape_parameters_that_a_template_lacks_are_left_out() -> None:
    body = tiny_body(shapes=2)
    betas = torch.tensor([0.5, -1.0, 3.0])
    vertices, joints = rest_shape(body, betas)
    wanted = shaped(body, betas[:2])
    assert torch.equal(vertices, wanted[0])
    assert torch.equal(joints, wanted[1])
    plain = default_body()
    assert torch.equal(rest_shape(plain, betas)[0], plain.vertices)
