"""The UNet: shapes, zeros before training, weights from the generator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation
from tiny_people import NET, people, person
from torch import Tensor

from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.predict.ghg.network import (
    HEADS,
    AtlasNetwork,
    AtlasPerson,
    GatedConv,
    TexelMaps,
    guess_unseen_colours,
    inpaint_colours,
    network_inputs,
    predict_avatar,
)


def test_predictions_are_zero_before_training() -> None:
    found = AtlasNetwork(NET, torch.Generator().manual_seed(0))(torch.rand(30, 32, 32))
    assert found.shape == (2, sum(HEADS.values()), 32, 32)
    assert (found == 0).all()


Shown = tuple[AtlasPerson, TexelMaps]
INPAINTED = NET.model_copy(update={"unseen_colours": "inpainted"})
MEAN = torch.full((3, NET.resolution, NET.resolution), 0.25)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    shown = person(people(tmp_path_factory.mktemp("people"), (1,)) / "p1")
    return shown, shown.observe([0, 3, 6])


def constant_network(bias: dict[str, float] | None = None) -> AtlasNetwork:
    """Return a network with constant output: 0, or ``bias`` in every channel of some heads."""
    made = AtlasNetwork(NET, torch.Generator().manual_seed(0))
    names = [name for _ in range(2) for name, count in HEADS.items() for _ in range(count)]
    with torch.no_grad():
        made.heads.bias.copy_(torch.tensor([(bias or {}).get(name, 0.0) for name in names]))  # type: ignore[union-attr]
    return made


def predicted(shown: Shown, bias: dict[str, float] | None = None) -> HumanScene:
    with torch.no_grad():
        return predict_avatar(*shown, MEAN, constant_network(bias))


def matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) of unit quaternions."""
    w = quats[:, :1].clamp(-1, 1)
    xyz = quats[:, 1:]
    return axis_angle_to_matrix(
        torch.nn.functional.normalize(xyz, dim=1)
        * 2
        * torch.atan2(xyz.norm(dim=1, keepdim=True), w)
    )


def test_the_skin_is_whole_and_scaffolds_are_carved(shown: Shown) -> None:
    """Above the skin: seen, and inside the silhouettes of all three views."""
    sitter, maps = shown
    found = predicted(shown).anchors
    kept = (maps.inside[1] == 1) & (maps.seen[1] > 0)
    assert (found.points[: len(sitter.texels)] == sitter.texels.points).all()
    torch.testing.assert_close(
        found.points[len(sitter.texels) :],
        (sitter.texels.points + 0.02 * sitter.texels.normals)[kept],
    )


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
    fractions = torch.tensor([0.0, 2.0, 0.0]).softmax(0)
    guess = (fractions[:, None, None] * guess_unseen_colours(sitter, maps, MEAN)).sum(0)
    torch.testing.assert_close(trusting[~seen], guess[~seen] + 0.5)
    wary = predicted(shown, {"colour": 0.5, "image_weight": -50.0}).gaussians.base_rgb
    torch.testing.assert_close(wary[: len(sitter.texels)], guess + 0.5)


def test_inpainting_fills_the_dilated_hole_alone(shown: Shown) -> None:
    """Against a dilation in SciPy; texels beside the hole keep the colours of the images."""
    sitter, maps = shown
    made = AtlasNetwork(INPAINTED, torch.Generator().manual_seed(0))
    plain = constant_network().state_dict()
    own = made.state_dict()
    assert all(torch.equal(own[name], x) for name, x in plain.items() if name[0] != "h")
    assert made.inpainting is not None
    with torch.no_grad():
        avatar = predict_avatar(*shown, MEAN, made)
        painted, beside = inpaint_colours(sitter, maps, made.inpainting)
    size = NET.resolution
    unseen = np.zeros(size * size, dtype=bool)
    unseen[sitter.texels.index.numpy()] = (maps.seen[0] == 0).numpy()
    hole = np.asarray(binary_dilation(unseen.reshape(size, size), np.ones((5, 5))), dtype=bool)
    expected = hole.ravel()[sitter.texels.index.numpy()]
    assert 0.1 < expected.mean() < 0.9
    assert np.array_equal(beside.numpy(), ~expected)
    torch.testing.assert_close(painted[beside], maps.rgb[0][beside])
    rgb = avatar.gaussians.base_rgb[: len(sitter.texels)]
    torch.testing.assert_close(rgb, painted, atol=1e-5, rtol=0)
    assert float((painted[~beside] - 0.5).abs().mean()) > 0.01
    colours = replace(maps, rgb=torch.where(maps.seen[..., None] > 0, maps.rgb, 7.0))
    with torch.no_grad():
        again, _ = inpaint_colours(sitter, colours, made.inpainting)
    torch.testing.assert_close(again, painted)  # colours in the hole are not read


def test_a_gated_convolution_is_elu_times_twice_the_sigmoid() -> None:
    layer = GatedConv(2, 3, stride=2, dilation=2).double()
    images = torch.randn(1, 2, 8, 8, dtype=torch.float64, requires_grad=True)
    plain = torch.nn.functional.conv2d(images, layer.weight, layer.bias, 2, 2, 2)
    value = plain[:, :3]
    gate = plain[:, 3:]
    expected = torch.where(value > 0, value, value.exp() - 1) * 2 / (1 + (-gate).exp())
    torch.testing.assert_close(layer(images), expected)
    assert torch.autograd.gradcheck(layer, images)


def test_inpainting_learns(shown: Shown) -> None:
    made = AtlasNetwork(INPAINTED, torch.Generator().manual_seed(0))
    assert made.inpainting is not None
    predict_avatar(*shown, MEAN, made).gaussians.base_rgb.square().sum().backward()
    for name, parameter in made.inpainting.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.any()), name


def test_all_heads_learn(shown: Shown) -> None:
    made = constant_network()
    avatar = predict_avatar(*shown, MEAN, made)
    sum(x.square().sum() for x in avatar.gaussians.tensors().values()).backward()  # type: ignore[union-attr]
    assert made.heads.bias is not None
    grad = made.heads.bias.grad
    assert grad is not None
    moved = dict(zip(HEADS, grad.view(2, -1)[0].split(tuple(HEADS.values())), strict=True))
    assert {name for name, x in moved.items() if bool((x == 0).all())} <= {"rotation"}, (
        "a turn changes no length"
    )


def test_inputs_hold_everything_in_the_atlas(shown: Shown) -> None:
    sitter, maps = shown
    found = network_inputs(sitter, maps, guess_unseen_colours(sitter, maps, MEAN))
    assert found.shape == (6 * 2 + 18, NET.resolution, NET.resolution)
    assert found[-2].sum() == len(sitter.texels)
    torch.testing.assert_close(found[-1], found[-2] / 3)
    changed_maps = replace(maps, rgb=1 - maps.rgb)
    other = network_inputs(sitter, changed_maps, guess_unseen_colours(sitter, changed_maps, MEAN))
    changed = (found != other).flatten(1).any(1)
    level = [True] * 3 + [False] * 3
    other_side = [True] * 3
    assert changed.tolist() == level + level + [False] * 12 + other_side + [False] * 3
