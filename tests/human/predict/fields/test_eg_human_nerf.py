"""Positions of guided samples, opacities from signed ray distances, and images of EG-HumanNeRF."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyngs.human.predict.fields.eg_human_nerf import (
    PARAMS,
    EgHumanNerf,
    expected_surface,
    opacities,
)
from dyngs.human.predict.fields.network import EncodedPerson
from dyngs.human.predict.people import (
    BodyBoundaries,
    Person,
    cameras_in_metres,
    crop_source_images,
    crop_window,
)


def network_with() -> EgHumanNerf:
    return EgHumanNerf(torch.Generator().manual_seed(0))


def known(network: EgHumanNerf, person: Person) -> EncodedPerson:
    body, scale = person.body_in(person.views[0])
    return network.encode(crop_source_images([person.images[i] for i in (0, 2, 4)], scale), body)


def test_the_surface_is_where_the_distance_first_crosses_zero() -> None:
    at = torch.tensor([[1.0, 2.0, 3.0, 4.0]]).expand(5, -1)
    signed = torch.tensor(
        [
            [3.0, 1.0, -1.0, 2.0],  # once, between the second and the third
            [3.0, 1.0, -3.0, -1.0],
            [3.0, 0.5, 1.0, 2.0],  # never
            [-1.0, -2.0, 1.0, -1.0],  # at once, then out and in again
            [2.0, -1.0, 1.0, -1.0],  # twice
        ]
    )
    found = expected_surface(at, signed)
    torch.testing.assert_close(found, torch.tensor([2.5, 2.25, 2.0, 3.5, 1 + 2 / 3]))


def test_a_surface_hides_what_is_behind_it_and_nothing_else_is_opaque() -> None:
    at = torch.linspace(0.9, 1.1, 41)[None]
    hit = opacities(at, 1.0 - at, torch.tensor(400.0))
    through = (1 - hit).cumprod(1)
    assert float(through[0, -1]) < 1e-3
    assert float(through[0, 16]) > 0.97, "2 cm before it"
    assert float(hit[0, 20]) == pytest.approx(
        1 - 1 / (1 + 2.718281828) / (2.718281828 / (1 + 2.718281828)), abs=1e-2
    )
    missed = opacities(at, torch.full_like(at, PARAMS.limit), torch.tensor(400.0))
    assert float((1 - missed).prod()) > 0.99


def test_an_untrained_network_shows_the_body(person: Person) -> None:
    """Its samples lie around it, a window is the part of the whole but for the refinement, and
    weights are learned."""
    network = network_with()
    body, scale = person.body_in(person.views[0])
    camera = cameras_in_metres(person.images[1].cameras, scale)
    with torch.no_grad():
        whole = network.render(known(network, person), camera)
        part = network.render(
            known(network, person),
            cameras_in_metres(crop_window(person.images[1], 8, 10, 16).cameras, scale),
        )
    torch.testing.assert_close(
        part.transmittance, whole.transmittance[10:26, 8:24], atol=1e-4, rtol=1e-3
    )
    seen = BodyBoundaries(body).depth(camera)
    alpha = 1 - whole.transmittance
    assert float(alpha[seen.isfinite()].mean()) > 0.8
    assert float(alpha[seen.isinf()].mean()) < 0.1
    solid = seen.isfinite() & (alpha > 0.9)
    assert float(((whole.depth / alpha)[solid] - seen[solid]).abs().median()) < 0.06


def test_all_weights_are_learned_alike(person: Person) -> None:
    network = network_with()
    image = crop_window(person.images[1], 12, 4, 16)
    _, scale = person.body_in(person.views[0])
    grads = []
    for _ in range(2):
        picture = network.render(
            known(network, person),
            cameras_in_metres(image.cameras, scale),
            torch.Generator().manual_seed(1),
        )
        total = (
            picture.colour.square().sum()
            + picture.transmittance.sum()
            + network.penalty(picture, image, scale)
        )
        grads.append(torch.autograd.grad(total, list(network.parameters())))
    assert all(torch.equal(a, b) for a, b in zip(*grads, strict=True))
    assert all(bool(x.isfinite().all()) for x in grads[0])
    still = [
        name
        for (name, _), x in zip(network.named_parameters(), grads[0], strict=True)
        if not bool(x.any())
    ]
    assert set(still) <= {"attention.layers.1.bias", "blend.layers.2.bias"}, (
        "a softmax does not see them"
    )


def test_penalty_compares_distances_with_depth_maps(person: Person) -> None:
    """The penalty is zero for true distances, both of rays that hit a person and of those that
    miss."""
    network = network_with()
    image = crop_window(person.images[1], 12, 4, 16)
    _, scale = person.body_in(person.views[0])
    picture = network.render(known(network, person), cameras_in_metres(image.cameras, scale))
    off = float(network.penalty(picture, image, scale).detach())
    assert image.depth is not None
    assert image.alpha is not None
    local = torch.linalg.inv(image.cameras.intrinsics[0]) @ torch.stack(
        [
            *reversed(
                torch.meshgrid(torch.arange(16) + 0.5, torch.arange(16) + 0.5, indexing="ij")
            ),
            torch.ones(16, 16),
        ]
    ).flatten(1)
    lengths = local.norm(dim=0)
    true = []
    limit = PARAMS.limit
    for rays, at, _ in picture.samples:
        surface = (image.depth.flatten() / scale * lengths)[rays][:, None]
        meets = image.alpha.flatten()[rays][:, None] > 0.5
        signed = torch.where(meets, surface - at, limit).clamp(-limit, limit)
        true.append((rays, at, signed))
    told = float(network.penalty(replace(picture, samples=true), image, scale))
    assert told < 1e-4 < off
