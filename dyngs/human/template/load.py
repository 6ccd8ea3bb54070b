"""The body template that a config names, in a person's shape."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dyngs.config import HumanModel
from dyngs.data.capture import BodyFrames
from dyngs.errors import DyngsError
from dyngs.human.template.body import BodyTemplate, apply_shape
from dyngs.human.template.body_reader import read_body

DEFAULT_TEMPLATE = Path(__file__).parent / "files" / "anny_smplx55.npz"
"""The file of the free template that comes with the package."""


def default_template() -> BodyTemplate:
    """Read the free template of the package: an adult of 1.76 m in T-pose, 55 joints in the order of SMPL-X."""
    return read_body(DEFAULT_TEMPLATE)


def template_path(model: HumanModel) -> Path:
    """Return the path of the body file that ``model`` names, or of the free template."""
    return DEFAULT_TEMPLATE if model.body is None else model.body


def load_template(model: HumanModel) -> BodyTemplate:
    """Read the template that ``model`` names, or the free one.

    Raises:
        DyngsError: the file cannot be read.
    """
    if model.body is None and model.uv is None:
        return default_template()
    if model.body is None:
        raise DyngsError(f"model.uv={model.uv} goes with model.body; the free template has its own texture coordinates")
    return read_body(model.body, model.uv)


def rest_shape(body: BodyTemplate, given: BodyFrames) -> tuple[Tensor, Tensor]:
    """Return vertices (M, 3) and joints (J, 3) at rest in the shape of ``given``; what ``body`` lacks is ignored.

    A template with another shape space than that of ``given`` stays as it is.
    """
    if (given.shape_space == "anny") != (body.name == "anny"):
        return body.vertices, body.joints
    with torch.no_grad():
        return apply_shape(body, torch.from_numpy(given.betas).to(body.vertices)[: body.num_shapes])
