"""The body template that a person is built on, in that person's shape."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dyngs.config import HumanModel
from dyngs.errors import DyngsError
from dyngs.human.template.body import BodyTemplate, apply_shape
from dyngs.human.template.body_reader import read_body

DEFAULT_TEMPLATE = Path(__file__).parent / "files" / "anny_smplx55.npz"
"""The free template that comes with the package."""


def default_template() -> BodyTemplate:
    """The free template that comes with the package: an adult of 1.76 m in T-pose, 55 joints in the order of SMPL-X."""
    return read_body(DEFAULT_TEMPLATE)


def template_path(model: HumanModel) -> Path:
    """The body file that ``model`` names, or that of the free template."""
    return DEFAULT_TEMPLATE if model.body is None else model.body


def load_template(model: HumanModel) -> BodyTemplate:
    """The body file that ``model`` names, or the free template.

    Raises:
        DyngsError: the file cannot be read.
    """
    if model.body is None and model.uv is None:
        return default_template()
    if model.body is None:
        raise DyngsError(f"model.uv={model.uv} goes with model.body; the free template has texture coordinates")
    return read_body(model.body, model.uv)


def rest_shape(body: BodyTemplate, betas: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices (M, 3) and joints (J, 3) at rest in the shape ``betas`` (B,), of which those count that ``body`` has.

    A body without a shape space is as it is: bone lengths are learned.
    """
    with torch.no_grad():
        return apply_shape(body, betas[: body.num_shapes])
