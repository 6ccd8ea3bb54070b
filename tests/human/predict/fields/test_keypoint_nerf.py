"""The code of key points, the cells that hold a person, and pictures of KeypointNeRF."""

from __future__ import annotations

import math

import pytest
import torch

from dyngs.human.predict.fields.keypoint_nerf import (
    CODE,
    PARAMS,
    KeypointNerf,
    spatial_code,
)
from dyngs.human.predict.fields.network import EncodedPerson
from dyngs.human.predict.kind import FieldKeys
from dyngs.human.predict.people import (
    Person,
    PosedBody,
    Sources,
    cameras_in_metres,
    crop_source_images,
    crop_window,
)


@pytest.fixture(scope="module")
def network() -> KeypointNerf:
    return KeypointNerf(torch.Generator().manual_seed(0), FieldKeys())


def given(person: Person, views: tuple[int, ...] = (0, 2, 4)) -> tuple[Sources, PosedBody, float]:
    body, scale = person.body_in(person.views[0])
    return crop_source_images([person.images[i] for i in views], scale), body, scale


def known(
    network: KeypointNerf, person: Person, views: tuple[int, ...] = (0, 2, 4)
) -> EncodedPerson:
    sources, body, _ = given(person, views)
    with torch.no_grad():
        return network.encode(sources, body)


def test_the_code_is_that_of_the_paper(person: Person) -> None:
    """Number by number, in float64."""
    sources, body, _ = given(person)
    points = body.key_points[:5] + torch.tensor([0.05, -0.02, 0.08])
    found = spatial_code(points, body.key_points, sources)
    assert found.shape == (3, 5, CODE)
    for view in range(3):
        pose = sources.cam_from_world[view].double()
        depths = [
            (x.double() @ pose[:3, :3].T + pose[:3, 3])[:, 2] for x in (points, body.key_points)
        ]
        for m in range(5):
            for j in range(22):
                dz = float(depths[0][m] - depths[1][j])
                near = math.exp(
                    -float((points[m] - body.key_points[j]).double().square().sum())
                    / (2 * PARAMS.reach**2)
                )
                waves = [
                    f(math.pi * 2**octave * dz) for octave in range(3) for f in (math.sin, math.cos)
                ]
                expected = torch.tensor([near * x for x in (dz, *waves)])
                torch.testing.assert_close(found[view, m, j::22], expected, atol=2e-5, rtol=0)


def test_occupied_cells_cover_only_the_body(network: KeypointNerf, person: Person) -> None:
    """The bones close the cells that two opposite images leave open."""
    for views in ((0, 2, 4), (0, 4)):
        own = known(network, person, views)
        space, occupied = own.extra
        cells = (space.unit(own.body.vertices) * space.cells).long()
        x, y, z = cells.unbind(1)
        shown = (own.alpha(own.body.vertices) > 0.5).all(0)
        assert float(shown.float().mean()) > 0.5, "at 40 px many vertices lie on the outline"
        assert bool(occupied[0, z, y, x][shown].all())
        assert 0.001 < float(occupied.float().mean()) < 0.15


def test_a_part_of_a_picture_is_the_same_alone(network: KeypointNerf, person: Person) -> None:
    """And pictures do not depend on the order of the images."""
    own, (_, _, scale) = known(network, person), given(person)
    image = person.images[1]
    with torch.no_grad():
        whole = network.render(own, cameras_in_metres(image.cameras, scale))
        part = network.render(own, cameras_in_metres(crop_window(image, 8, 10, 16).cameras, scale))
        turned = network.render(
            known(network, person, (4, 0, 2)), cameras_in_metres(image.cameras, scale)
        )
    torch.testing.assert_close(part.colour, whole.colour[10:26, 8:24], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(turned.transmittance, whole.transmittance, atol=1e-4, rtol=1e-3)
    assert image.alpha is not None
    alpha = 1 - whole.transmittance
    assert float(alpha[image.alpha > 0.9].mean()) > 0.5, "an untrained network fills the cells"
    assert float(alpha.mean()) < 0.5


def test_all_weights_are_learned(network: KeypointNerf, person: Person) -> None:
    """The same random numbers give the same gradients."""
    sources, body, scale = given(person)
    camera = cameras_in_metres(crop_window(person.images[1], 8, 10, 16).cameras, scale)
    grads = []
    for _ in range(2):
        picture = network.render(
            network.encode(sources, body), camera, torch.Generator().manual_seed(1)
        )
        total = picture.colour.square().sum() + picture.transmittance.sum()
        grads.append(torch.autograd.grad(total, list(network.parameters())))
    assert all(torch.equal(a, b) for a, b in zip(*grads, strict=True))
    assert all(bool(x.abs().sum() > 0) for x in grads[0])
