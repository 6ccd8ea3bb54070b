"""Clothes and hair of synthetic people: colours, patterns and cut, chosen by a seed.

Local letters: P points, U vertices of the atlas, S texels per side.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.mesh import Fragments, interpolate, rasterize, vertex_normals

_PARTS = {
    "eye": ("eye",),
    "head": ("neck", "head", "jaw"),
    "torso": ("pelvis", "spine", "collar"),
    "arm": ("shoulder",),
    "forearm": ("elbow",),
    "hand": ("wrist", "index", "middle", "pinky", "ring", "thumb"),
    "leg": ("hip", "knee"),
    "shoe": ("ankle", "foot"),
}
"""The joints of each part of the body, without side and number."""
_BELOW_KNEE = -0.36  # height at which shorts end in T-pose, m


@dataclass(frozen=True)
class Outfit:
    """Clothes and hair of a person in T-pose, and the person's size."""

    palette: dict[str, np.ndarray]  # sRGB values (3,) by name of cloth or part of the body
    pitch: float = 1.0  # width of stripes and checks, relative to 0.05 m
    upright: bool = False  # whether the stripes on the front are vertical
    long_sleeves: bool = False  # whether sleeves and legs reach the hands and shoes
    long_legs: bool = True
    shirt: float = 0.0  # of these the largest offset from the skin, m
    trousers: float = 0.0
    hair: float = 0.0
    folds: float = 20.0  # spatial frequency, radians per metre
    size: float = 1.0  # of the person, relative to the template


def random_outfit(seed: int, is_usual: bool = False) -> Outfit:
    """Return the outfit of ``seed``. 0 is the bare template, painted; others have clothes with
    offsets of up to 4 cm, differ in cut and pattern, and are 0.88 to 1.04 times as tall.

    ``is_usual``: left mostly as right, back as front, bare hands; else all of these differ, to show
    what is mixed up.
    """
    palette = _palette(seed)
    if is_usual:
        palette = _usual(palette, np.random.default_rng([seed, 4]))
    if seed == 0:
        return Outfit(palette)
    make = np.random.default_rng([seed, 1])
    return Outfit(
        palette,
        pitch=float(make.uniform(0.7, 2.5)),
        upright=bool(make.uniform() < 0.5),
        long_sleeves=bool(make.uniform() < 0.5),
        long_legs=bool(make.uniform() < 0.7),
        shirt=float(make.uniform(0.005, 0.04)),
        trousers=float(make.uniform(0.005, 0.04)),
        hair=float(make.uniform(0.005, 0.04)),
        folds=float(make.uniform(10.0, 30.0)),
        size=float(make.uniform(0.88, 1.04)),
    )


def dress_body(body: BodyTemplate, outfit: Outfit) -> BodyTemplate:
    """Return ``body`` with the clothes as part of its surface; joints, weights and atlas stay the
    same."""
    vertices = body.vertices.double().cpu().numpy()
    away = _cloth_offsets(vertices, _part_weights(body), _left_eye(body), outfit)
    moved = vertices + away[:, None] * vertex_normals(vertices, body.faces.cpu().numpy())
    return replace(body, vertices=torch.from_numpy(moved).to(body.vertices))


def paint_texture(body: BodyTemplate, outfit: Outfit, resolution: int = 512) -> np.ndarray:
    """Return the texture (S, S, 3) of ``outfit``, sRGB in [0, 1], float64; left and right, front
    and back differ.

    Texels that no triangle covers repeat the nearest covered one, so that interpolation at seams is
    correct. The template is in T-pose, with texture coordinates and the 55 joints of SMPL-X;
    ``resolution`` is S. Raises DyngsError: the template has no texture coordinates.
    """
    texture_coordinates(body)  # raises where there are none
    fragments, nearest = _covered(body.uv, body.uv_faces, resolution)
    around = body.faces.cpu().numpy()[fragments.faces]
    points = interpolate(fragments.barycentric, body.vertices.double().cpu().numpy()[around])
    parts = interpolate(fragments.barycentric, _part_weights(body)[around]).argmax(axis=1)
    texture = np.zeros((resolution * resolution, 3))
    texture[fragments.index] = _painted(
        points, np.array(list(_PARTS))[parts], _left_eye(body), outfit
    )
    return texture[nearest]


@lru_cache(maxsize=1)  # people of a set share one atlas
def _covered(uv: Tensor, uv_faces: Tensor, resolution: int) -> tuple[Fragments, np.ndarray]:
    """Return the texels that the atlas covers, and of every texel the number (S, S) of the nearest
    one covered."""
    columns, rows = texel_coordinates(uv.double().cpu().numpy(), resolution)
    corners = np.stack([columns, rows, np.ones_like(rows)], axis=-1)[uv_faces.cpu().numpy()]
    fragments = rasterize(corners, resolution, resolution)
    is_bare = np.ones(resolution * resolution, dtype=bool)
    is_bare[fragments.index] = False
    near = distance_transform_edt(
        is_bare.reshape(resolution, -1), return_distances=False, return_indices=True
    )
    row, column = np.asarray(near)
    return fragments, row * resolution + column


def texture_coordinates(body: BodyTemplate) -> tuple[np.ndarray, np.ndarray]:
    """Return texture coordinates (U, 2), float64, and the triangles (T, 3) that index them.

    Raises DyngsError: the template has none.
    """
    if body.uv is None or body.uv_faces is None:
        raise DyngsError(
            f"the body template '{body.name}' has no texture coordinates; give one with a texture atlas"
        )
    return body.uv.double().cpu().numpy(), body.uv_faces.cpu().numpy()


def texel_coordinates(uv: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return column and row (U,) of ``uv`` (U, 2) in a texture, whole numbers at texel centres."""
    return uv[:, 0] * resolution - 0.5, (1.0 - uv[:, 1]) * resolution - 0.5


def _left_eye(body: BodyTemplate) -> np.ndarray:
    return body.joints[JOINT_NAMES.index("left_eye")].double().cpu().numpy()


def _part_weights(body: BodyTemplate) -> np.ndarray:
    """Return the weights (M, 8) of each vertex for the parts of ``_PARTS``; rows sum to 1."""
    bases = [
        name.removeprefix("left_").removeprefix("right_").rstrip("123") for name in JOINT_NAMES
    ]
    member = np.array(
        [[base in names for names in _PARTS.values()] for base in bases], dtype=np.float64
    )
    return body.weights.double().cpu().numpy() @ member


def _cloth_offsets(
    vertices: np.ndarray, part_weights: np.ndarray, eye: np.ndarray, outfit: Outfit
) -> np.ndarray:
    """Return the offsets (M,) of clothes and hair from the skin along the normal, m."""
    x, y, z = vertices.T
    of = dict(zip(_PARTS, part_weights.T, strict=True))
    waist = _smoothstep((y - 0.1) / 0.08)
    below = _smoothstep((_BELOW_KNEE - y) / 0.06)
    sleeves = of["arm"] + (of["forearm"] if outfit.long_sleeves else 0.0)
    legs = of["leg"] * (1.0 if outfit.long_legs else 1.0 - below) + of["torso"] * (1.0 - waist)
    legs = legs * _smoothstep(np.abs(x) / 0.05) * (0.5 + 0.5 * _smoothstep(-y / 0.6))
    scalp = of["head"] * np.maximum(
        _smoothstep((y - eye[1] - 0.03) / 0.04), _smoothstep((-0.02 - z) / 0.04)
    )
    scalp = scalp * _smoothstep((y - eye[1] + 0.1) / 0.06)
    folds = 0.8 + 0.2 * np.sin(outfit.folds * (y + 0.5 * x) + 4.0 * np.arctan2(z, np.abs(x) - 0.1))
    return (
        folds * (outfit.shirt * (of["torso"] * waist + sleeves) + outfit.trousers * legs)
        + outfit.hair * scalp
    )


def _smoothstep(x: np.ndarray) -> np.ndarray:
    x = x.clip(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _palette(seed: int) -> dict[str, np.ndarray]:
    """Return sRGB values (3,) by name of cloth or part: well separated hues in an order that
    ``seed`` chooses."""
    make = np.random.default_rng(seed)
    names = (
        "shirt",
        "stripe",
        "back",
        "left_leg",
        "right_leg",
        "left_hand",
        "right_hand",
        "left_shoe",
        "right_shoe",
    )
    hues = (make.permutation(len(names)) + make.uniform()) / len(names)
    values = {"shirt": 0.85, "stripe": 0.95, "back": 0.6, "left_leg": 0.6, "right_leg": 0.75}
    colors = {
        name: np.array(colorsys.hsv_to_rgb(hue, make.uniform(0.55, 0.85), values.get(name, 0.9)))
        for name, hue in zip(names, hues, strict=True)
    }
    skin = make.uniform(0.35, 0.9)
    hair = make.uniform(0.1, 0.5)
    return colors | {
        "skin": skin * np.array([1.0, 0.8, 0.68]),
        "hair": hair * np.array([1.0, 0.75, 0.5]),
    }


def _usual(palette: dict[str, np.ndarray], make: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the palette of clothes that a person would wear: half of the shirts are of one colour,
    colours are less saturated and of any lightness, and one shirt in five has another back."""
    names = ("shirt", "stripe", "back", "left_leg", "left_shoe")
    muted = {
        name: make.uniform(0.25, 1.1) * (palette[name] + make.uniform(0.0, 1.5) * 0.5) / 1.5
        for name in names
    }
    muted = {name: color.clip(0.03, 0.97) for name, color in muted.items()}
    if make.uniform() < 0.5:
        muted["stripe"] = muted["shirt"]
    if make.uniform() < 0.8:
        muted["back"] = muted["shirt"]
    sides = {f"right_{part}": muted[f"left_{part}"] for part in ("leg", "shoe")}
    muted["cuff"] = muted["stripe"]
    return palette | muted | sides | {f"{side}_hand": palette["skin"] for side in ("left", "right")}


def _painted(points: np.ndarray, part: np.ndarray, eye: np.ndarray, outfit: Outfit) -> np.ndarray:
    """Return the colours (P, 3) of ``points`` (P, 3) in T-pose, m, by ``part`` (P,); ``eye`` (3,)
    is the left eye."""
    x, y, z = points.T
    is_left = x > 0
    is_front = z > -0.02
    side = np.abs(x)
    palette = outfit.palette
    pitch = outfit.pitch

    def either(name: str) -> np.ndarray:
        return np.where(is_left[:, None], palette[f"left_{name}"], palette[f"right_{name}"])

    def striped(
        along: np.ndarray, width: float, first: np.ndarray, second: np.ndarray
    ) -> np.ndarray:
        return np.where((np.floor(along / (width * pitch)) % 2 == 0)[:, None], first, second)

    def disc(center_x: float, center_y: float, radius: float) -> np.ndarray:
        return is_front & (np.hypot(x - center_x, y - center_y) < radius)

    rgb = np.broadcast_to(palette["skin"], points.shape).copy()
    is_head, is_torso, is_leg = (part == name for name in ("head", "torso", "leg"))
    white = np.full(3, 0.95)
    black = np.full(3, 0.08)
    red = np.array([0.75, 0.1, 0.1])
    shirt = palette["shirt"]
    stripe = palette["stripe"]
    back = palette["back"]
    checks = 0.65 + 0.35 * ((np.floor(y / (0.06 * pitch)) + np.floor(z / (0.06 * pitch))) % 2)
    trousers = checks[:, None] * either("leg")
    ahead, behind = (x, y) if outfit.upright else (y, x)
    torso = np.where(
        is_front[:, None], striped(ahead, 0.05, shirt, stripe), striped(behind, 0.06, back, stripe)
    )
    sleeves = np.where(
        is_left[:, None],
        striped(side, 0.05, shirt, stripe),
        striped(side, 0.08, back, palette.get("cuff", white)),
    )
    is_sleeve = (part == "arm") | ((part == "forearm") & outfit.long_sleeves)
    is_leg = is_leg & (outfit.long_legs | (y > _BELOW_KNEE))
    for where, colors in (
        (is_torso, torso),
        (is_torso & disc(0.09, 0.47, 0.05), white),
        (is_torso & (y < 0.18), black),
        (is_leg | (is_torso & (y < 0.14)), trousers),
        (is_sleeve, sleeves),
        ((part == "forearm") & is_left & (np.abs(side - 0.62) < 0.03), black),
        (part == "hand", either("hand")),
        (part == "shoe", either("shoe")),
        (is_head & ((y > eye[1] + 0.05) | (~is_front & (y > eye[1] - 0.06))), palette["hair"]),
        (is_head & (disc(eye[0], eye[1], 0.02) | disc(-eye[0], eye[1], 0.02)), black),
        (part == "eye", white),
        (is_head & (np.hypot(x / 2.5, y - eye[1] + 0.075) < 0.011) & (z > 0.05), red),
        (is_head & disc(eye[0] + 0.012, eye[1] - 0.042, 0.014), palette["left_hand"]),
    ):
        rgb[where] = colors[where] if colors.ndim == 2 else colors
    return rgb
