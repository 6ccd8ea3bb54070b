"""Positions of guided samples, opacities from signed ray distances, and images of EG-HumanNeRF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.human.predict.fields.eg_human_nerf import (
    PARAMS,
    EgHumanNerf,
    Refinement,
    expected_surface,
    opacities,
)
from dyngs.human.predict.fields.keypoint_nerf import KeypointNerf
from dyngs.human.predict.fields.network import EncodedPerson, FieldNetwork
from dyngs.human.predict.kind import FieldKeys
from dyngs.human.predict.people import (
    Person,
    cameras_in_metres,
    crop_source_images,
    crop_window,
)


def untrained() -> EgHumanNerf:
    return EgHumanNerf(torch.Generator().manual_seed(0), FieldKeys())


def without_refinement() -> EgHumanNerf:
    """A network whose refinement changes no image."""
    network = untrained()
    torch.nn.init.zeros_(network.refine.last.weight)
    return network


def known(network: FieldNetwork, person: Person) -> EncodedPerson:
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
    torch.testing.assert_close(found[:, 0], torch.tensor([2.5, 2.25, 2.0, 3.5, 1 + 2 / 3]))


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


def test_gradients_of_opacities() -> None:
    generator = torch.Generator().manual_seed(0)
    at = torch.rand(3, 5, generator=generator, dtype=torch.float64).sort(1).values
    signed = torch.randn(3, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    sharpness = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, x: opacities(at, s, x), (signed, sharpness))


def test_hidden_views_are_excluded(person: Person) -> None:
    """Colours of an image in which the body hides all samples do not count.

    Samples beside its silhouette are not hidden.
    """
    network = without_refinement()
    own = known(network, person)
    camera = cameras_in_metres(person.images[1].cameras, person.body_in(person.views[0])[1])
    hidden = torch.full_like(own.extra, 1e3)
    hidden[1] = 0
    pictures = []
    with torch.no_grad():
        for colour in (0.0, 1.0):
            rgba = own.sources.rgba.clone()
            rgba[1, :3] = colour * rgba[1, 3:]
            sources = replace(own.sources, rgba=rgba)
            pictures.append(
                network.render(replace(own, sources=sources, extra=hidden), camera).colour
            )
    alpha = person.images[1].alpha
    assert alpha is not None
    difference = float((pictures[0] - pictures[1]).abs().amax(-1)[alpha > 0.9].median())
    assert difference < 1e-6


def test_without_refinement_a_window_is_part_of_the_whole(person: Person) -> None:
    network = without_refinement()
    own = known(network, person)
    scale = person.body_in(person.views[0])[1]
    with torch.no_grad():
        whole = network.render(own, cameras_in_metres(person.images[1].cameras, scale))
        window = crop_window(person.images[1], 8, 10, 16).cameras
        part = network.render(own, cameras_in_metres(window, scale))
    torch.testing.assert_close(part.colour, whole.colour[10:26, 8:24], atol=1e-4, rtol=1e-3)


def test_refinement_does_not_see_the_sides_of_a_patch() -> None:
    """It treats a patch of even colour evenly, up to its sides."""
    refinement = Refinement()
    even = torch.full((12, 20), 0.2)
    colour = torch.tensor([0.3, 0.5, 0.1]).expand(12, 20, 3)
    found = refinement(colour, even, 2 * even, 2.5)
    torch.testing.assert_close(found, found[:1, :1].expand_as(found), atol=1e-5, rtol=1e-5)
    assert not torch.equal(found[0, 0], colour[0, 0])


@pytest.mark.parametrize("network_of", [EgHumanNerf, KeypointNerf])
def test_supersampling_averages_rays(
    network_of: Callable[..., FieldNetwork], person: Person
) -> None:
    network = network_of(torch.Generator().manual_seed(0), FieldKeys(supersampling=2))
    if isinstance(network, EgHumanNerf):
        torch.nn.init.zeros_(network.refine.last.weight)  # changes no image
    own = known(network, person)
    scale = person.body_in(person.views[0])[1]
    camera = cameras_in_metres(person.images[1].cameras, scale)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2] *= 2
    doubled = Cameras(camera.cam_from_world, intrinsics, 2 * camera.width, 2 * camera.height)
    with torch.no_grad():
        soft = network.render(own, camera)
        network.keys = FieldKeys()
        fine = network.render(own, doubled)
        hard = network.render(own, camera)
    for name in ("colour", "transmittance", "depth"):
        values = getattr(fine, name).view(camera.height, 2, camera.width, 2, -1).mean((1, 3))
        torch.testing.assert_close(getattr(soft, name), values.view_as(getattr(soft, name)))
    assert float((soft.transmittance - hard.transmittance).abs().max()) > 0.1


def test_an_untrained_network_shows_the_body(person: Person) -> None:
    """Its samples lie around it, a window is the part of the whole but for the refinement, and
    weights are learned."""
    network = untrained()
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
    seen = body.depth(camera)
    alpha = 1 - whole.transmittance
    assert float(alpha[seen.isfinite()].mean()) > 0.8
    assert float(alpha[seen.isinf()].mean()) < 0.1
    solid = seen.isfinite() & (alpha > 0.9)
    assert float(((whole.depth / alpha)[solid] - seen[solid]).abs().median()) < 0.06


def test_all_weights_are_learned_alike(person: Person) -> None:
    network = untrained()
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
    network = untrained()
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
    outline = replace(image, alpha=torch.full_like(image.alpha, 0.5))
    assert float(network.penalty(picture, outline, scale)) == 0, "half covered pixels show both"
