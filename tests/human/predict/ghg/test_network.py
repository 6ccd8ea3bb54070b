"""The UNet: shapes, zeros before training, weights from the generator."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_people import NET, people, person
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.predict.ghg.network import (
    HEADS,
    AtlasNetwork,
    PredictedAvatar,
    guessed_colours,
    network_inputs,
    num_input_channels,
    predict_gaussians,
)
from dyngs.human.predict.ghg.person import CapturedPerson
from dyngs.human.predict.ghg.texel_maps import TexelMaps


def network(seed: int = 0, widths: tuple[int, ...] = (8, 16)) -> AtlasNetwork:
    return AtlasNetwork(6, 3, widths, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("widths", [(8,), (8, 16), (8, 16, 24)])
def test_predictions_are_zero_before_training(widths: tuple[int, ...]) -> None:
    found = network(0, widths)(torch.rand(6, 32, 32))
    assert found.shape == (3, sum(HEADS.values()), 32, 32)
    assert (found == 0).all()


def test_weights_come_from_the_generator_alone() -> None:
    torch.manual_seed(1)
    first = network().state_dict()
    torch.manual_seed(2)
    again = network().state_dict()
    other = network(1).state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["last.0.weight"], other["last.0.weight"])


def test_every_weight_matters_once_the_heads_do() -> None:
    made = network()
    generator = torch.Generator().manual_seed(3)
    torch.nn.init.normal_(made.heads.weight, generator=generator)
    made(torch.rand(6, 32, 32, generator=generator)).square().sum().backward()
    for name, parameter in made.named_parameters():
        assert parameter.grad is not None, name
        assert bool((parameter.grad != 0).any()), name


def test_what_is_far_away_in_the_atlas_is_seen() -> None:
    """A texel's input changes predictions at the other side: unseen parts are painted by what is
    seen elsewhere."""
    made = network(0, (8, 8, 8, 8))
    generator = torch.Generator().manual_seed(3)
    torch.nn.init.normal_(made.heads.weight, generator=generator)
    maps = torch.rand(6, 32, 32, generator=generator)
    other = maps.clone()
    other[:, :4, :4] = 0
    assert bool((made(maps)[..., 28:, 28:] != made(other)[..., 28:, 28:]).any())


def test_odd_widths_are_refused() -> None:
    with pytest.raises(DyngsError, match="multiples of 8"):
        network(0, (8, 12))


Shown = tuple[CapturedPerson, TexelMaps]
MEAN = torch.full((3, NET.resolution, NET.resolution), 0.25)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    filmed = person(people(tmp_path_factory.mktemp("people"), (1,)) / "p1")
    return filmed.sitter, filmed.look([0, 3, 6])


def constant_network(bias: dict[str, float] | None = None) -> AtlasNetwork:
    """One that says the same everywhere: 0, or ``bias`` in every number of some heads."""
    made = AtlasNetwork(num_input_channels(2), 2, (8, 8), torch.Generator().manual_seed(0))
    names = [name for _ in range(2) for name, count in HEADS.items() for _ in range(count)]
    with torch.no_grad():
        made.heads.bias.copy_(torch.tensor([(bias or {}).get(name, 0.0) for name in names]))  # type: ignore[union-attr]
    return made


def predicted(shown: Shown, bias: dict[str, float] | None = None) -> PredictedAvatar:
    with torch.no_grad():
        return predict_gaussians(*shown, MEAN, constant_network(bias), 0.9)


def matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) of unit quaternions."""
    w = quats[:, :1].clamp(-1, 1)
    xyz = quats[:, 1:]
    return axis_angle_to_matrix(
        torch.nn.functional.normalize(xyz, dim=1)
        * 2
        * torch.atan2(xyz.norm(dim=1, keepdim=True), w)
    )


def test_without_a_network_texels_have_seen_or_nearby_colours(shown: Shown) -> None:
    sitter, maps = shown
    bare = predict_gaussians(sitter, maps, MEAN, None, 0.9).gaussians
    count = len(sitter.texels)
    seen = maps.seen[0] > 0
    torch.testing.assert_close(bare.base_rgb[:count][seen], maps.rgb[0][seen])
    torch.testing.assert_close(bare.base_rgb[:count][~seen], maps.nearby[~seen])
    assert 0.5 < seen.float().mean() < 1


def test_an_untrained_network_changes_colours_a_little_and_nothing_else(shown: Shown) -> None:
    """It trusts images by 98 %, and mixes the mean into what it guesses."""
    bare = predict_gaussians(*shown, MEAN, None, 0.9)
    untrained = predicted(shown)
    for name in ("means", "log_scales", "logit_opacities"):
        assert torch.equal(getattr(bare.gaussians, name), getattr(untrained.gaussians, name))
    torch.testing.assert_close(untrained.gaussians.quats, bare.gaussians.quats)
    different = (bare.gaussians.base_rgb - untrained.gaussians.base_rgb).abs()
    count = len(shown[0].texels)
    seen = shown[1].seen[0] > 0
    assert 0 < different[:count][seen].max() < 0.02
    assert 0 < different[:count][~seen].max() < 0.25


def test_the_skin_is_whole_and_scaffolds_are_carved(shown: Shown) -> None:
    """Above the skin: seen, and inside the silhouettes of all three views."""
    sitter, maps = shown
    found = predicted(shown).subject.anchors
    kept = (maps.inside[1] == 1) & (maps.seen[1] > 0)
    assert (found.points[: len(sitter.texels)] == sitter.texels.points).all()
    torch.testing.assert_close(
        found.points[len(sitter.texels) :],
        (sitter.texels.points + 0.02 * sitter.texels.normals)[kept],
    )
    every = predict_gaussians(sitter, maps, MEAN, None, 0.0).gaussians
    assert len(found) < len(every) == len(sitter.texels) + int((maps.seen[1] > 0).sum())


def test_every_quaternion_is_normalised_by_itself(shown: Shown) -> None:
    """(1, 0, 0, 0) + 1 in all four is a turn by 2 acos(2 / sqrt 7) about the diagonal of each
    tangent frame."""
    bare = predicted(shown).gaussians
    turned = predicted(shown, {"rotation": 1.0}).gaussians
    torch.testing.assert_close(turned.quats.norm(dim=1), torch.ones(len(turned)))
    angle = 2 * torch.tensor(2 / 7**0.5).acos()
    expected = matrices(bare.quats) @ axis_angle_to_matrix(torch.ones(3) / 3**0.5 * angle)
    torch.testing.assert_close(matrices(turned.quats), expected, atol=1e-5, rtol=0)  # float32


def test_places_lengths_and_opacities_stay_within_bounds(shown: Shown) -> None:
    """However loud the network: half way to the next scaffold along the normal, e^1.5 times as
    long."""
    sitter, _ = shown
    bare = predicted(shown).gaussians
    loud = predicted(shown, {"height": 50.0, "scale": 50.0, "opacity": 2.0}).gaussians
    count = len(sitter.texels)
    torch.testing.assert_close(
        loud.means[:count], bare.means[:count] + 0.01 * sitter.texels.normals
    )
    torch.testing.assert_close(loud.log_scales, bare.log_scales + 1.5)
    torch.testing.assert_close(loud.logit_opacities, bare.logit_opacities + 2)


def test_unseen_texels_are_painted_and_mistrusted_ones_too(shown: Shown) -> None:
    sitter, maps = shown
    seen = maps.seen[0] > 0
    trusting = predicted(shown, {"colour": 0.5, "image_weight": 50.0}).gaussians.base_rgb[
        : len(sitter.texels)
    ]
    torch.testing.assert_close(trusting[seen], maps.rgb[0][seen])
    mean, nearby, other_side = guessed_colours(sitter, maps, MEAN)
    guess = torch.stack([mean, nearby, other_side], dim=-1) @ torch.tensor([0.0, 2.0, 0.0]).softmax(
        0
    )
    torch.testing.assert_close(trusting[~seen], guess[~seen] + 0.5)
    wary = predicted(shown, {"colour": 0.5, "image_weight": -50.0}).gaussians.base_rgb
    torch.testing.assert_close(wary[: len(sitter.texels)], guess + 0.5)


def test_the_other_side_is_the_mirror_image(shown: Shown) -> None:
    """Of each texel's colour where that is seen, else as nearby; the mean is the mean."""
    sitter, maps = shown
    mean, nearby, other_side = guessed_colours(sitter, maps, MEAN)
    assert bool((mean == 0.25).all())
    assert torch.equal(nearby, maps.nearby)
    is_seen = maps.seen[0][sitter.mirror] > 0
    assert torch.equal(other_side[is_seen], maps.rgb[0][sitter.mirror][is_seen])
    assert torch.equal(other_side[~is_seen], nearby[~is_seen])


def test_all_heads_learn(shown: Shown) -> None:
    made = constant_network()
    avatar = predict_gaussians(*shown, MEAN, made, 0.9)
    sum(x.square().sum() for x in avatar.gaussians.tensors().values()).backward()  # type: ignore[union-attr]
    grad = made.heads.bias.grad
    assert grad is not None
    moved = dict(zip(HEADS, grad.view(2, -1)[0].split(tuple(HEADS.values())), strict=True))
    assert {name for name, x in moved.items() if bool((x == 0).all())} <= {"rotation"}, (
        "a turn changes no length"
    )


def test_inputs_hold_everything_in_the_atlas(shown: Shown) -> None:
    sitter, maps = shown
    found = network_inputs(sitter, maps, MEAN)
    assert found.shape == (num_input_channels(2), NET.resolution, NET.resolution)
    assert found[-2].sum() == len(sitter.texels)
    torch.testing.assert_close(found[-1], found[-2] / 3)
    other = network_inputs(sitter, replace(maps, rgb=1 - maps.rgb), MEAN)
    changed = (found != other).flatten(1).any(1)
    level = [True] * 3 + [False] * 3
    other_side = [True] * 3
    assert changed.tolist() == level + level + [False] * 12 + other_side + [False] * 3
