"""Maps of images: the colours of a painted person, what is hidden, silhouettes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.capture import BodyFrames, Capture, View
from dyngs.data.geometry import from_opengl_pose
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.synthetic.captures import CAMERA_ANGLE_X
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.mesh import Fragments, interpolate
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.predict.ghg.network import (
    MAX_SILHOUETTE_DISTANCE,
    AtlasPerson,
    atlas_person,
    fill_unseen_colours,
    observe_texels,
)
from dyngs.human.predict.people import captured_person
from dyngs.human.synthetic.capture import (
    Paint,
    PosedMesh,
    render_mesh,
)


@cache
def texels() -> Texels:
    body = default_template()
    return atlas_texels(body, 64, body.vertices)


def test_unseen_texels_take_colours_from_their_surroundings() -> None:
    """The back of a person seen from the front: legs like legs, the chest like the chest; what is
    seen stays."""
    points = texels().points
    normals = texels().normals
    seen = normals[:, 2].clamp_min(0)
    rgb = torch.where(
        (points[:, 1] > 0)[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    )
    found = fill_unseen_colours(texels(), rgb * (seen > 0)[:, None], seen)
    assert torch.equal(found[seen > 0], rgb[seen > 0])
    away = (seen == 0) & (points[:, 1].abs() > 0.15)
    assert away.sum() > 100
    assert ((found - rgb)[away].abs().amax(1) < 0.01).float().mean() > 0.99


SIZE = 96
FRONT = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3.5], [0, 0, 0, 1]])
RIGHT = np.array([[0.0, 0, -1, -3.5], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""OpenGL poses that look at the middle of the template from before it, and from its right side."""


@cache
def body() -> BodyTemplate:
    return default_template()


def sitter(poses: Tensor) -> AtlasPerson:
    """A person of whom there is one view, in the pose (55, 3), scaffolds at 0 and 4 cm."""
    view = View("v", Path("v.png"), from_opengl_pose(FRONT), np.eye(3), SIZE, SIZE, frame=0)
    frames = BodyFrames(
        (0,), poses[None].double().numpy(), np.zeros((1, 3)), np.zeros(10), np.ones(1)
    )
    capture = Capture(
        Path("person"), "body_json", {"train": (view,)}, has_alpha=True, body={"train": frames}
    )
    images = cast(ImageLoader, SimpleNamespace(views=(view,)))
    person = captured_person(capture, body(), images)
    return atlas_person(person, HumanPredictorModel(resolution=64, scaffold_heights=(0.0, 0.04)))


def arms_before_the_chest() -> Tensor:
    """(55, 3): forearms before the chest, across."""
    poses = torch.zeros(55, 3)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        poses[JOINT_NAMES.index(f"{side}_shoulder")] = torch.tensor([0.0, -1.2 * sign, 0.0])
        poses[JOINT_NAMES.index(f"{side}_elbow")] = torch.tensor([0.0, -1.5 * sign, 0.0])
    return poses


def painted(colour_of: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Paint:
    """Paint by positions (P, 3) of the T-pose and the joint (P,) that moves each."""

    def paint(fragments: Fragments) -> np.ndarray:
        around = body().faces.numpy()[fragments.faces]
        positions = interpolate(fragments.barycentric, body().vertices.double().numpy()[around])
        weights = interpolate(fragments.barycentric, body().weights.double().numpy()[around])
        return colour_of(positions, weights.argmax(1))

    return paint


def grey(fragments: Fragments) -> np.ndarray:
    return np.full((len(fragments.index), 3), 0.5)


def image(poses: Tensor, paint: Paint, pose: np.ndarray) -> Image:
    exact = body().to(dtype=torch.float64)
    vertices = posed_vertices(exact, poses[None].double(), torch.zeros(1, 3).double())[0].numpy()
    pixels = render_mesh(PosedMesh(vertices, body().faces.numpy(), paint), pose, SIZE, 2)
    rgba = torch.from_numpy(pixels).float()
    focal = 0.5 * SIZE / np.tan(0.5 * CAMERA_ANGLE_X)
    intrinsics = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]).float()
    camera = Cameras(
        torch.from_numpy(from_opengl_pose(pose)).float()[None], intrinsics[None], SIZE, SIZE
    )
    return Image("v", camera, rgba[..., :3] * rgba[..., 3:], rgba[..., 3], None, None, 0)


def is_arm(joints: np.ndarray | Tensor) -> np.ndarray:
    names = np.array(JOINT_NAMES)[np.asarray(joints)]
    arm = ("shoulder", "elbow", "wrist", "index", "middle", "pinky", "ring", "thumb")
    return np.array([any(part in name for part in arm) for name in names])


def test_distances_from_the_edge_are_those_of_the_outline() -> None:
    """From the front, texels on the outer side of the legs lie on it, and those 4 cm above them 4
    cm outside."""
    shown = sitter(torch.zeros(55, 3))
    seen = image(torch.zeros(55, 3), grey, FRONT)
    maps = observe_texels(shown, [seen])
    points = shown.texels.points
    normals = shown.texels.normals
    outer = (
        (normals[:, 0] * points[:, 0].sign() > 0.98) & (points[:, 1] < -0.1) & (points[:, 1] > -0.7)
    )
    assert outer.sum() > 10
    assert maps.silhouette_distance[0, outer].abs().max() < 0.025
    torch.testing.assert_close(
        maps.silhouette_distance[1, outer].mean(), torch.tensor(-0.04), atol=0.008, rtol=0
    )
    middle = (points[:, 1] - 0.3).abs() < 0.05
    assert (
        maps.silhouette_distance[:, middle & (points[:, 0].abs() < 0.05)] == MAX_SILHOUETTE_DISTANCE
    ).all()
    assert maps.count == 1


def test_texels_behind_an_arm_do_not_get_its_colour() -> None:
    """Arms red, the rest blue: of the texels seen, nearly all have their own colour, and parts of
    the chest are hidden that are seen when the arms are aside. Mixed colours remain where a pixel
    covers both."""
    paint = painted(
        lambda _, joints: np.where(is_arm(joints)[:, None], [0.9, 0.0, 0.0], [0.0, 0.0, 0.9])
    )
    crossed = sitter(arms_before_the_chest())
    maps = observe_texels(crossed, [image(arms_before_the_chest(), paint, FRONT)])
    arms = torch.from_numpy(is_arm(crossed.texels.weights.argmax(1)))
    redness = maps.rgb[0, :, 0] / maps.rgb[0].sum(1).clamp_min(1e-6)
    seen = maps.seen[0] > 0.3
    assert (redness[seen & arms] > 0.5).float().mean() > 0.9, "fingers are thinner than a pixel"
    assert (redness[seen & ~arms] < 0.5).float().mean() > 0.98
    aside = sitter(torch.zeros(55, 3))
    free = observe_texels(aside, [image(torch.zeros(55, 3), paint, FRONT)])
    x, y, _ = aside.texels.points.T
    chest = (free.seen[0] > 0.8) & ~arms & (x.abs() < 0.2) & ((y - 0.55).abs() < 0.08)
    assert (maps.seen[0][chest] == 0).float().mean() > 0.1, "forearms cover a part of it"


def test_a_texel_has_the_colour_of_its_place() -> None:
    """A smooth colour over the body, from two sides; up to the light and half a pixel of its
    change."""
    paint = painted(lambda positions, _: 0.5 + 0.4 * np.sin(3 * positions))
    aside = sitter(torch.zeros(55, 3))
    shown = [image(torch.zeros(55, 3), paint, pose) for pose in (FRONT, RIGHT)]
    maps = observe_texels(aside, shown)
    seen = maps.seen[0] > 0.5
    truth = 0.5 + 0.4 * torch.sin(3 * aside.texels.points)
    hue = [x / x.sum(1, keepdim=True).clamp_min(1e-6) for x in (maps.rgb[0][seen], truth[seen])]
    assert (hue[0] - hue[1]).abs().amax(1).quantile(0.95) < 0.05
    assert seen.float().mean() > 0.4
