"""The mesh of a person: seams of the atlas, and the shape that a run does not store but implies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bare_person import bare_scene, template
from synthetic_bodies import model, write_npz

from dyngs.errors import DyngsError
from dyngs.export.rigged.body import anchor_normals, body_mesh, rest_vertices
from dyngs.human.avatar.anchors import texel_gaussians
from dyngs.human.avatar.posing import Skeleton
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.body import apply_shape
from dyngs.human.template.body_reader import read_body


def test_vertices_are_doubled_at_seams_only() -> None:
    """Each corner keeps its place and its texture coordinate; copies share weights and normals."""
    body, scene = template(), bare_scene()
    mesh = body_mesh(scene, body, body.vertices)
    assert body.uv is not None
    assert body.uv_faces is not None
    assert len(mesh.vertices) == len(torch.unique(torch.stack([body.faces, body.uv_faces], -1).reshape(-1, 2), dim=0))
    assert torch.equal(mesh.vertices[mesh.faces], body.vertices[body.faces])
    assert torch.equal(mesh.uv[mesh.faces], body.uv[body.uv_faces])
    assert torch.equal(mesh.weights, body.weights[mesh.source])
    outward = ((mesh.vertices - torch.tensor([0.0, 0.2, 0.0])) * mesh.normals).sum(1)
    trunk = mesh.weights[:, [3, 6, 9]].sum(1) > 0.9
    assert float((outward[trunk] > 0).float().mean()) > 0.95
    torch.testing.assert_close(mesh.normals.norm(dim=1), torch.ones(len(mesh.normals)), atol=1e-5, rtol=0)


def test_the_shape_follows_from_what_a_run_holds(tmp_path: Path) -> None:
    """Ten shape parameters from joints and anchors, to a tenth of a millimetre."""
    body = read_body(write_npz(tmp_path / "body.npz", model("smplx")))
    betas = torch.linspace(-2, 2, 10)
    vertices, joints = apply_shape(body, betas)
    texels = atlas_texels(body, 32, vertices)
    gaussians, anchors = texel_gaussians(texels, [0.0, 0.02], 0)
    scene = replace(bare_scene(), gaussians=gaussians, anchors=anchors, skeleton=Skeleton(joints, body.parents))
    torch.testing.assert_close(rest_vertices(scene, body), vertices, atol=1e-4, rtol=0)
    np.testing.assert_allclose(anchor_normals(anchors, body, vertices).norm(dim=1).numpy(), 1, atol=1e-5)


def test_templates_that_do_not_fit() -> None:
    scene, body = bare_scene(), template()
    torch.testing.assert_close(rest_vertices(scene, body), body.vertices, atol=1e-4, rtol=0)
    with pytest.raises(DyngsError, match="is not the one that this person was trained on"):
        rest_vertices(scene, replace(body, faces=body.faces[:100], uv_faces=None, uv=None))
    with pytest.raises(DyngsError, match=r"has no texture coordinates; train with model\.uv=FILE\.obj"):
        body_mesh(scene, replace(body, uv=None, uv_faces=None), body.vertices)
