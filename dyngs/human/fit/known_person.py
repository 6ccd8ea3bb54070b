"""The shape of a person who was fitted before, for new clips of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from dyngs.config.io import load_config
from dyngs.data.body_frames import read_body_file
from dyngs.data.capture import BodyFrames
from dyngs.errors import DyngsError, reading
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.load import rest_shape

_BODY, _CONFIG = "body_train.npz", "config.yaml"


def known_shape(path: Path) -> BodyFrames:
    """Return the body parameters of a person, of whom only the shape counts.

    Args:
        path: a capture or a folder that ``dyngs data fit`` wrote, or the run of an avatar trained on one.

    Raises:
        DyngsError: none of these, or a shape that is not of the free template.
    """
    with reading(path, "give a capture that `dyngs data fit` wrote, or a run trained on it"):
        folder = path
        if (path / _CONFIG).is_file():
            data = load_config(path / _CONFIG).data
            folder = data.root if data.body is None else data.body
        if not (folder / _BODY).is_file():
            raise DyngsError(f"{path}: no fitted person there; give a capture that `dyngs data fit` wrote, or its run")
        found = read_body_file(folder / _BODY)
    if found.shape_space != "anny":
        raise DyngsError(f"{folder / _BODY}: is of another template; fit that person with `dyngs data fit` first")
    return found


def with_shape(body: BodyTemplate, known: BodyFrames) -> BodyTemplate:
    """Return the template whose mean shape is that of a known person."""
    vertices, joints = rest_shape(body, known)
    return replace(body, vertices=vertices, joints=joints)


def shape_of(body: BodyTemplate, known: BodyFrames) -> torch.Tensor:
    """Return the known shape parameters (B,) of a template with B of them; 0 for those that are not known."""
    betas = torch.zeros(body.num_shapes, device="cpu")
    given = torch.from_numpy(known.betas[: len(betas)]).float()
    betas[: len(given)] = given
    return betas
