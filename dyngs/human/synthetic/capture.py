"""Synthetic captures of clothed people: motions, outfits and rendered captures with exact body
parameters.

Rendered by the NumPy mesh rasteriser, independently of the Gaussian rasteriser. Symbols: F frames,
M vertices, T triangles, P points, H fragments, S pixels per side.
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.data.images.maps import MILLIMETRE
from dyngs.data.read import PEOPLE_FILE
from dyngs.data.synthetic.captures import CAMERA_ANGLE_X
from dyngs.human.body.body import BodyTemplate, apply_shape, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES, mirrored_joints
from dyngs.human.body.mesh import Fragments, interpolate, normalized, rasterize, vertex_normals
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.io.outputs import atomic_folder, require_new_folder
from dyngs.io.write import write_image, write_text

Paint = Callable[[Fragments], np.ndarray]
"""sRGB values (H, 3) in [0, 1] of visible points of a surface."""
FPS = 12.0
_Rotations = dict[str, np.ndarray]  # axis-angle vectors (F, 3) or (1, 3) by joint, rad
_SIDES = (("left", 1.0), ("right", -1.0))
_KEY_POSES = 4  # key poses of a random clip


def _clip(body: BodyTemplate, num_frames: int, seed: int | None, is_new: bool) -> Motion:
    """Return the motion of ``seed``: a walk, a squat or a dance of random extent and heading.

    ``is_new`` selects a second motion. Without a seed, the first motion is a walk, the second a
    squat. The soles are at y = 0.
    """
    time = np.linspace(0.0, 1.0, num_frames)
    if seed is None:
        return _grounded_motion(body, (_squat if is_new else _walk)(time, 1.0, 0.0), num_frames)
    generator = np.random.default_rng([2 * seed + is_new, 2])
    heading = float(generator.uniform(-np.pi, np.pi))
    match int(generator.integers(4)):
        case 0:
            rotations = _walk(time, float(generator.uniform(0.5, 1.2)), heading)
        case 1:
            rotations = _squat(time, float(generator.uniform(0.4, 1.0)), heading)
        case _:
            rotations = _dance(time, generator, heading)
    return _grounded_motion(body, rotations, num_frames)


def _walk(time: np.ndarray, extent: float, heading: float) -> _Rotations:
    """Return three steps in place while the body turns by 50 degrees; ``time`` (F,) in [0, 1],
    ``heading`` in rad."""
    swing = extent * np.sin(3 * np.pi * time)
    lift = 0.3 - 0.3 * np.cos(3 * np.pi * time)
    rotations = {
        "pelvis": _axis_angle(y=np.radians(50.0) * (time - 0.5) + heading),
        "spine2": _axis_angle(y=0.2 * swing),
        "head": _axis_angle(y=0.5 * np.sin(2 * np.pi * time)),
    }
    for side, sign in _SIDES:
        rotations |= {
            f"{side}_hip": _axis_angle(x=-0.5 * sign * swing),
            f"{side}_knee": _axis_angle(x=0.2 + 0.6 * np.maximum(-sign * swing, 0.0) + 0.3 * lift),
            f"{side}_shoulder": _axis_angle(x=0.6 * sign * swing, z=-sign * 1.15),
            f"{side}_elbow": _axis_angle(y=-sign * (0.3 + lift)),
        }
    return rotations


def _squat(time: np.ndarray, extent: float, heading: float) -> _Rotations:
    """Return a motion from standing into a squat, with arms rising sideways."""
    depth = extent * (0.5 - 0.5 * np.cos(np.pi * time))
    rotations = {
        "pelvis": _axis_angle(y=heading),
        "spine1": _axis_angle(x=0.35 * depth),
        "head": _axis_angle(x=-0.3 * depth, z=0.2 * depth),
    }
    for side, sign in _SIDES:
        rotations |= {
            f"{side}_hip": _axis_angle(x=-1.3 * depth, z=0.15 * sign * depth),
            f"{side}_knee": _axis_angle(x=1.9 * depth),
            f"{side}_ankle": _axis_angle(x=-0.6 * depth),
            f"{side}_shoulder": _axis_angle(z=sign * (-1.2 + 2.1 * depth)),
            f"{side}_elbow": _axis_angle(y=-0.4 * sign * depth),
        }
    return rotations


def _dance(time: np.ndarray, generator: np.random.Generator, heading: float) -> _Rotations:
    """Return a smooth motion through random key poses."""

    def random_curve(low: float, high: float) -> np.ndarray:
        knots = generator.uniform(low, high, _KEY_POSES)
        return PchipInterpolator(np.linspace(0.0, 1.0, _KEY_POSES), knots)(time)

    rotations = {
        "pelvis": _axis_angle(y=heading + random_curve(-0.5, 0.5)),
        "spine1": _axis_angle(
            x=random_curve(-0.05, 0.3), y=random_curve(-0.2, 0.2), z=random_curve(-0.12, 0.12)
        ),
        "spine2": _axis_angle(y=random_curve(-0.2, 0.2), z=random_curve(-0.12, 0.12)),
        "head": _axis_angle(
            x=random_curve(-0.25, 0.25), y=random_curve(-0.6, 0.6), z=random_curve(-0.15, 0.15)
        ),
    }
    for side, sign in _SIDES:
        bent = random_curve(0.0, 1.0)
        rotations |= {
            f"{side}_hip": _axis_angle(
                x=-0.9 * bent + 0.2,
                y=sign * random_curve(0.0, 0.3),
                z=sign * random_curve(0.02, 0.35),
            ),
            f"{side}_knee": _axis_angle(x=random_curve(0.0, 0.3) + 0.9 * bent),
            f"{side}_shoulder": _axis_angle(
                x=random_curve(-0.4, 0.4),
                y=-sign * random_curve(-0.2, 0.7),
                z=sign * random_curve(-1.2, 0.5),
            ),
            f"{side}_elbow": _axis_angle(
                x=random_curve(-0.3, 0.3), y=-sign * random_curve(0.05, 1.5)
            ),
        }
    return rotations


def _grounded_motion(body: BodyTemplate, rotations: _Rotations, num_frames: int) -> Motion:
    """Return a motion from axis-angle joint rotations (F, 3) or (1, 3), its lowest vertex always
    at y = 0."""
    device = body.vertices.device
    poses = torch.zeros(num_frames, len(JOINT_NAMES), 3, device=device)
    for name, rotation in rotations.items():
        poses[:, JOINT_NAMES.index(name)] = torch.from_numpy(rotation).to(poses)
    trans = torch.zeros(num_frames, 3, device=device)
    heights = posed_vertices(body.to(dtype=torch.float64), poses.double(), trans.double())[..., 1]
    trans[:, 1] = -heights.amin(1).float()
    return Motion(
        poses, trans, torch.zeros(10, device=device), FPS, torch.ones(num_frames, device=device)
    )


def _axis_angle(
    x: np.ndarray | float = 0.0, y: np.ndarray | float = 0.0, z: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return axis-angle vectors (F, 3) of rotations about the fixed axes z, y, x by angles (F,),
    rad."""
    angles = np.stack(np.broadcast_arrays(np.atleast_1d(z), y, x), axis=-1)
    return Rotation.from_euler("zyx", angles).as_rotvec()


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
"""Joints of each body part, without side and number."""
_SHORTS_HEM = -0.36  # height of the hem of shorts in T-pose, m
_WAIST = 0.18  # height of the upper edge of trousers and skirts in T-pose, m
_HEMS = ((_WAIST, _WAIST), (0.0, 0.12), (-0.2, 0.05), (-0.6, -0.2))
"""Ranges of the lower edge of shirts in trousers, loose shirts, jackets and dresses, m."""
_CUTS = {
    "pitch": (0.2, 2.5),
    "shirt": (0.005, 0.04),
    "trousers": (0.005, 0.05),
    "hair": (0.005, 0.04),
    "folds": (10.0, 30.0),
    "size": (0.88, 1.04),
    "flare": (-0.2, 1.2),
    "opening": (-0.4, 0.4),
    "neckline": (0.0, 0.12),
    "shoes": (0.005, 0.015),
    "hairline": (0.0, 0.05),
    "long_hair": (-0.3, 0.3),
    "logo": (-0.1, 0.06),
    "checks": (-0.5, 0.35),
}
"""Ranges of random cuts; a negative value means 0."""


@dataclass(frozen=True)
class Outfit:
    """Clothes, hair and body size of a person in T-pose."""

    palette: dict[str, np.ndarray]  # sRGB values (3,) by name of garment or body part
    pitch: float = 1.0  # width of stripes and checks, relative to 0.05 m
    vertical_stripes: bool = False  # on the front
    long_sleeves: bool = False
    long_legs: bool = True
    shirt: float = 0.0  # largest offset from the skin, m
    trousers: float = 0.0
    hair: float = 0.0
    folds: float = 20.0  # spatial frequency, radians per metre
    size: float = 1.0  # of the person, relative to the template
    hem: float = _WAIST  # height of the lower edge of the shirt, jacket, dress or skirt, m
    flare: float = 0.0  # widening of the skirt per metre below the waist
    opening: float = 0.0  # slope of the edges of an open jacket
    neckline: float = 0.0  # radius, m
    shoes: float = 0.0  # offset from the skin, m
    hairline: float = -0.02  # hair behind this z reaches the nape, m
    long_hair: float = 0.0  # length below the nape, m
    logo: float = 0.05  # radius, m
    checks: float = 0.35  # contrast of the checks of trousers
    grain: np.ndarray | None = None  # (W, 4) wave vectors, rad/m, and phases of fine texture


def random_outfit(seed: int, is_everyday: bool = False) -> Outfit:
    """Return the outfit of ``seed``; 0 is the painted template without clothes.

    Clothes differ in cut and pattern, with offsets up to 5 cm; people are 0.88 to 1.04 times as
    tall as the template. With ``is_everyday`` both sides, front and back mostly match, hands are
    bare, and some wear jackets or dresses; else all differ, so that mix-ups are visible.
    """
    palette = _palette(seed)
    if seed == 0:
        return Outfit(palette)
    generator = np.random.default_rng([seed, 1])
    cuts = {name: max(0.0, float(generator.uniform(*ends))) for name, ends in _CUTS.items()}
    hem = _WAIST
    if is_everyday:
        hem = float(generator.uniform(*_HEMS[generator.integers(len(_HEMS))]))
        palette = _everyday_palette(palette, np.random.default_rng([seed, 4]))
    if hem < _HEMS[2][0]:
        cuts["trousers"] = 0.0
        palette |= {f"{side}_leg": palette["skin"] for side, _ in _SIDES}
    return Outfit(
        palette,
        vertical_stripes=bool(generator.uniform() < 0.5),
        long_sleeves=bool(generator.uniform() < 0.5),
        long_legs=bool(generator.uniform() < 0.7),
        hem=hem,
        grain=generator.normal(size=(24, 4)) * np.exp(generator.uniform(2.0, 5.5, (24, 1))),
        **cuts,
    )


def dress_body(body: BodyTemplate, outfit: Outfit) -> BodyTemplate:
    """Return ``body`` with the clothes as part of its surface; joints, weights and UV map stay the
    same."""
    vertices = body.vertices.double().cpu().numpy()
    x, y, z = vertices.T
    eye = _left_eye(body)
    weight = dict(zip(_PARTS, _part_weights(body).T, strict=True))
    waist = _smoothstep((y - 0.1) / 0.08)
    below = _smoothstep((_SHORTS_HEM - y) / 0.06)
    sleeves = weight["arm"] + (weight["forearm"] if outfit.long_sleeves else 0.0)
    ankle = weight["shoe"] * _smoothstep((y + 0.76) / 0.03)
    legs = (weight["leg"] + ankle) * (1.0 if outfit.long_legs else 1.0 - below) + weight[
        "torso"
    ] * (1.0 - waist)
    legs = legs * _smoothstep(np.abs(x) / 0.05) * (0.5 + 0.5 * _smoothstep(-y / 0.6))
    scalp = weight["head"] * np.maximum(
        _smoothstep((y - eye[1] - 0.03) / 0.04), _smoothstep((outfit.hairline - z) / 0.04)
    )
    scalp = scalp * _smoothstep((y - eye[1] + 0.1) / 0.06)
    folds = 0.8 + 0.2 * np.sin(outfit.folds * (y + 0.5 * x) + 4.0 * np.arctan2(z, np.abs(x) - 0.1))
    offsets = (
        folds * (outfit.shirt * (weight["torso"] * waist + sleeves) + outfit.trousers * legs)
        + outfit.hair * scalp
        + outfit.shoes * weight["shoe"]
    )
    clothed = vertices + offsets[:, None] * vertex_normals(vertices, body.faces.cpu().numpy())
    falling = outfit.long_hair * scalp * _smoothstep((eye[1] + 0.05 - y) / 0.1)
    clothed -= falling[:, None] * np.array([0.0, 1.0, 0.3])
    is_covered = (weight["leg"] + weight["torso"] > 0.5) & (y > outfit.hem)
    clothed, weights = _with_skirt(clothed, body.weights.double().cpu().numpy(), is_covered, outfit)
    return replace(
        body,
        vertices=torch.from_numpy(clothed).to(body.vertices),
        weights=torch.from_numpy(weights).to(body.weights),
    )


def _with_skirt(
    vertices: np.ndarray, weights: np.ndarray, is_covered: np.ndarray, outfit: Outfit
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (M, 3) and joint weights (M, J) with the covered part of the legs closed.

    Both legs are mapped to half elliptic cylinders that meet between them. Weights are mixed with
    those of the other leg so that the halves still meet in other poses.
    """
    x, y, z = vertices.T
    hips = vertices[is_covered & (y < 0.25)]
    middle = 0.5 * (hips.max(axis=0) + hips.min(axis=0))
    radius = hips.max(axis=0) - middle
    angle = 0.65 * np.arctan2(z - middle[2], np.abs(x) - 0.6 * radius[0])
    angle = angle.clip(-1.6, 1.6)  # the halves overlap by a few millimetres
    widening = 1.05 + outfit.flare * (1.0 + 0.3 * np.sin(outfit.folds * angle)) * (_WAIST - y)
    around = np.stack([np.sign(x) * np.cos(angle), 0.0 * y, np.sin(angle)], axis=-1)
    shift = middle + radius * widening[:, None] * around - vertices
    shift[:, 1] = 0.0
    share = (is_covered * _smoothstep((_WAIST - y) / 0.15))[:, None]
    other = weights[:, list(mirrored_joints(len(JOINT_NAMES)))] - weights
    return vertices + share * shift, weights + share * (0.5 - 0.5 * np.cos(angle))[:, None] * other


def outfit_paint(body: BodyTemplate, outfit: Outfit) -> Paint:
    """Return the colours of ``outfit`` as a function of surface points of ``body``.

    The template is in T-pose and has the 55 joints of SMPL-X.
    """
    faces = body.faces.cpu().numpy()
    vertices = body.vertices.double().cpu().numpy()
    weights = _part_weights(body)
    names = np.array(list(_PARTS))

    def paint(fragments: Fragments) -> np.ndarray:
        around = faces[fragments.faces]
        points = interpolate(fragments.barycentric, vertices[around])
        parts = interpolate(fragments.barycentric, weights[around]).argmax(axis=1)
        return _painted(points, names[parts], _left_eye(body), outfit)

    return paint


def _left_eye(body: BodyTemplate) -> np.ndarray:
    return body.joints[JOINT_NAMES.index("left_eye")].double().cpu().numpy()


def _part_weights(body: BodyTemplate) -> np.ndarray:
    """Return the weights (M, 8) of vertices for the parts of ``_PARTS``; rows sum to 1."""
    bases = [
        name.removeprefix("left_").removeprefix("right_").rstrip("123") for name in JOINT_NAMES
    ]
    member = np.array(
        [[base in names for names in _PARTS.values()] for base in bases], dtype=np.float64
    )
    return body.weights.double().cpu().numpy() @ member


def _smoothstep(x: np.ndarray) -> np.ndarray:
    x = x.clip(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _palette(seed: int) -> dict[str, np.ndarray]:
    """Return sRGB values (3,) by garment or body part, with well separated hues."""
    generator = np.random.default_rng(seed)
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
    hues = (generator.permutation(len(names)) + generator.uniform()) / len(names)
    values = {"shirt": 0.85, "stripe": 0.95, "back": 0.6, "left_leg": 0.6, "right_leg": 0.75}
    colors = {
        name: np.array(
            colorsys.hsv_to_rgb(hue, generator.uniform(0.55, 0.85), values.get(name, 0.9))
        )
        for name, hue in zip(names, hues, strict=True)
    }
    skin = generator.uniform(0.35, 0.9)
    hair = generator.uniform(0.1, 0.5)
    return colors | {
        "skin": skin * np.array([1.0, 0.8, 0.68]),
        "hair": hair * np.array([1.0, 0.75, 0.5]),
    }


def _everyday_palette(
    palette: dict[str, np.ndarray], generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return a palette of everyday clothes.

    Half of the shirts have one colour, colours are less saturated, and one shirt in five has a
    different back.
    """
    names = ("shirt", "stripe", "back", "left_leg", "left_shoe", "hair")
    muted = {
        name: generator.uniform(0.25, 1.1)
        * (palette[name] + generator.uniform(0.0, 1.5) * 0.5)
        / 1.5
        for name in names
    }
    muted = {name: color.clip(0.03, 0.97) for name, color in muted.items()}
    if generator.uniform() < 0.5:
        muted["stripe"] = muted["shirt"]
    if generator.uniform() < 0.8:
        muted["back"] = muted["shirt"]
    sides = {f"right_{part}": muted[f"left_{part}"] for part in ("leg", "shoe")}
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

    rgb = np.broadcast_to(palette["skin"], points.shape).copy()
    is_head, is_torso, is_leg = (part == name for name in ("head", "torso", "leg"))
    white = np.full(3, 0.95)
    black = np.full(3, 0.08)
    red = np.array([0.75, 0.1, 0.1])
    is_dark = np.floor(points[:, 1:] / (0.06 * pitch)).sum(axis=1, keepdims=True) % 2
    trousers = (1.0 - outfit.checks * is_dark) * either("leg")
    is_sleeve = (part == "arm") | ((part == "forearm") & outfit.long_sleeves)
    is_main = np.where(is_sleeve, is_left, is_front)
    along = np.where(is_sleeve, side, np.where(is_front == outfit.vertical_stripes, x, y))
    is_stripe = np.floor(along / (0.05 * pitch)) % 2 == 1
    cloth = np.where(is_main[:, None], palette["shirt"], palette["back"])
    cloth[is_stripe] = palette["stripe"]
    for where, colors in (
        (is_torso | is_sleeve, cloth),
        (is_torso & is_front & (np.hypot(x - 0.09, y - 0.47) < outfit.logo), white),
        (is_torso & is_front & (side < outfit.opening * (y - 0.25)), white),
        (is_torso & (np.hypot(x, y - eye[1] + 0.14) < outfit.neckline), palette["skin"]),
        (is_torso & (y < _WAIST), black),
        (is_torso & (y < 0.14), trousers),
        (is_leg & (outfit.long_legs | (y > _SHORTS_HEM)), trousers),
        ((is_torso | is_leg) & (y < _WAIST) & (y > outfit.hem), cloth),
        (part == "hand", either("hand")),
        (part == "shoe", either("shoe")),
        (
            is_head & ((y > eye[1] + 0.05) | ((z < outfit.hairline) & (y > eye[1] - 0.06))),
            palette["hair"],
        ),
        (is_head & (np.hypot(side - eye[0], y - eye[1]) < 0.012) & is_front, black),
        (part == "eye", white),
        (is_head & (np.hypot(x / 2.5, y - eye[1] + 0.075) < 0.011) & (z > 0.05), red),
    ):
        rgb[where] = colors[where] if colors.ndim == 2 else colors
    if outfit.grain is not None:
        waves = np.sin(points @ outfit.grain[:, :3].T + outfit.grain[:, 3]).mean(axis=1)
        rgb *= 1.0 + 0.5 * waves[:, None]
    return rgb.clip(0.0, 1.0)


@dataclass(frozen=True)
class DirectionalLight:
    """Directional light plus ambient light and the light of a sky."""

    direction: tuple[float, float, float] = (0.35, 0.75, 0.56)  # towards the light, not normalised
    # factors on sRGB values, one or three; a surface facing the light receives ambient + diffuse
    ambient: tuple[float, ...] = (0.6,)
    diffuse: tuple[float, ...] = (0.45,)
    # (9, 1 or 3) factors of the quadratic polynomial of the normal n that is added: of n, its
    # squares and its products (Ramamoorthi and Hanrahan 2001)
    sky: Sequence[Sequence[float]] = ((0.0,),) * 9


@dataclass(frozen=True)
class HumanOptions:
    """Options of a synthetic capture of a person."""

    size: int = 128  # width and height in pixels
    num_frames: int = 12  # frames of the splits train and test
    num_pose_frames: int = 6  # frames of the split ``pose``, another motion; 0: no such split
    num_cameras: int = 8  # training cameras, on a ring around the person
    num_test: int = 2  # test cameras, between training cameras; 0: neither test nor ``pose``
    seed: int = 0  # of the outfit, see ``random_outfit``; output is reproducible to the byte
    samples: int = 2  # per pixel and axis
    body_seed: int | None = None  # of the body shape; None: that of the template
    # of light, motions (see ``_clip``) and camera ring, with depth maps; None: default light, a
    # walk, then a squat, and cameras alternately low and high at 3.5 m
    scene_seed: int | None = None
    everyday_clothes: bool = False  # see ``random_outfit``
    body_error: float = 0.0  # standard deviation of errors of the written shape parameters


@dataclass(frozen=True)
class PosedMesh:
    """Painted mesh in world coordinates; float64, m."""

    vertices: np.ndarray  # (M, 3) in the world
    faces: np.ndarray  # (T, 3) int64, counter-clockwise from outside
    paint: Paint  # sRGB values in [0, 1] of the surface

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit vertex normals (M, 3)."""
        return vertex_normals(self.vertices, self.faces)


def write_human_capture(out: Path, options: HumanOptions = HumanOptions()) -> Path:
    """Render a moving person and write a capture (layout of ``dyngs.data.readers.transforms``);
    return ``out``.

    Files: ``images/SPLIT/fFFF_cCC.png`` (RGBA, straight alpha), ``transforms_SPLIT.json`` (OpenGL
    poses, m, y up, floor at y = 0), and the exact body parameters ``body_train.npz`` and
    ``body_pose.npz``. The split test shows the frames of train from other cameras, ``pose``
    another motion. Raises DyngsError: options out of range.
    """
    least = min(options.size, options.num_frames, options.num_cameras, options.seed + 1)
    if least < 1:
        raise DyngsError("a synthetic person needs size, frames and cameras >= 1 and seed >= 0")
    body, betas = _person(options.body_seed)
    outfit = random_outfit(options.seed, options.everyday_clothes)
    clothed = dress_body(body, outfit)
    paint = outfit_paint(body, outfit)
    cameras = dict(enumerate(ring_cameras(options)))
    train = {number: pose for number, pose in cameras.items() if number < options.num_cameras}
    test = {number: pose for number, pose in cameras.items() if number >= options.num_cameras}
    light = random_light(options.scene_seed)
    error = np.random.default_rng([options.seed, 7]).normal(0, options.body_error, betas.shape)
    betas = betas + torch.from_numpy(error).to(betas)
    clips = {"train": (options.num_frames, {"train": train, "test": test})}
    if options.num_pose_frames and test:
        clips["pose"] = options.num_pose_frames, {"pose": test}
    with atomic_folder(out) as started:
        for name, (num_frames, splits) in clips.items():
            clip = _clip(body, num_frames, options.scene_seed, name == "pose")
            motion = replace(
                clip, trans=outfit.size * clip.trans, scale=outfit.size * clip.scale, betas=betas
            )
            meshes = _posed_meshes(clothed, motion, paint)
            for split, cameras in splits.items():
                write_split(started, split, meshes, cameras, options, light)
            layout = "smpl" if options.body_seed is None else "anny"
            write_amass(motion, started / f"body_{name}.npz", layout)
    return out


def _person(seed: int | None) -> tuple[BodyTemplate, Tensor]:
    """Return the template in a random shape, and its shape parameters (B,)."""
    body = default_template()
    if seed is None:
        return body, torch.zeros(10, device="cpu")
    betas = torch.randn(
        body.num_shapes, generator=torch.Generator().manual_seed(seed), device="cpu"
    )
    vertices, joints = apply_shape(body, betas)
    return replace(body, vertices=vertices, joints=joints), betas


def random_light(seed: int | None) -> DirectionalLight:
    """Return the light of ``seed``, from above the horizon; None: the default light.

    A white surface that faces the light reaches 75 to 105 % of white.
    """
    if seed is None:
        return DirectionalLight()
    generator = np.random.default_rng([seed, 3])
    azimuth = generator.uniform(-np.pi, np.pi)
    height = generator.uniform(0.0, 1.2)
    diffuse = generator.uniform(0.2, 0.6)
    ambient = generator.uniform(0.75, 1.05) - diffuse
    sky = generator.normal(0.0, 0.07, (9, 1)) + generator.normal(0.0, 0.02, (9, 3))
    sky[3:6] += generator.uniform(0.1, 0.3)  # the squares sum to 1
    return DirectionalLight(
        (float(np.sin(azimuth)), float(height), float(np.cos(azimuth))),
        (float(ambient),),
        (float(diffuse),),
        sky.tolist(),
    )


def render_mesh(
    mesh: PosedMesh,
    world_from_cam: np.ndarray,
    size: int,
    samples: int,
    light: DirectionalLight = DirectionalLight(),
) -> np.ndarray:
    """Render a mesh; return sRGB values and straight alpha (size, size, 4) in [0, 1].

    Lambertian: paint times ambient + diffuse max(n . l, 0), at most 1, with smooth normals n.
    Anti-aliased with ``samples`` x ``samples`` per pixel.

    Args:
        mesh: in world coordinates.
        world_from_cam: (4, 4) OpenGL pose; the camera is ``CAMERA_ANGLE_X`` wide.
        size: width and height, px.
        samples: per pixel and axis.
        light: of the scene.
    """
    wide = size * samples
    image = _image_of(mesh.vertices, world_from_cam, wide) - [0.5, 0.5, 0.0]
    fragments = rasterize(image[mesh.faces], wide, wide)
    around = mesh.normals[mesh.faces[fragments.faces]]
    normal = normalized(interpolate(fragments.barycentric, around))
    facing = np.maximum(normal @ normalized(np.array(light.direction)), 0.0)
    received = np.array(light.ambient) + np.array(light.diffuse) * facing[:, None]
    terms = np.hstack([normal, normal**2, normal * np.roll(normal, 1, axis=1)])
    sums = np.zeros((wide * wide, 4))
    sums[fragments.index, :3] = mesh.paint(fragments) * (received + terms @ np.array(light.sky))
    sums[fragments.index, 3] = 1.0
    sums = sums.clip(0.0, 1.0).reshape(size, samples, size, samples, 4).sum(axis=(1, 3))
    alpha = sums[..., 3:]
    return np.concatenate([sums[..., :3] / np.maximum(alpha, 1.0), alpha / samples**2], axis=-1)


def _image_of(points: np.ndarray, world_from_cam: np.ndarray, size: int) -> np.ndarray:
    """Project ``points`` (P, 3) before the camera to column, row and inverse depth (P, 3)."""
    x, up, back = ((points - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    focal = _focal(size)
    return np.stack(
        [0.5 * size - focal * x / back, 0.5 * size + focal * up / back, -1.0 / back], axis=-1
    )


def write_split(
    out: Path,
    split: str,
    meshes: list[PosedMesh],
    cameras: dict[int, np.ndarray],
    options: HumanOptions,
    light: DirectionalLight,
) -> None:
    """Write the images, depth maps and cameras of a split, with a mesh per frame; nothing without
    views.

    ``cameras`` are OpenGL poses (4, 4) by number.
    """
    entries = []
    size = options.size
    for i, mesh in enumerate(meshes):
        for camera, pose in cameras.items():
            name = f"{split}/f{i:03d}_c{camera:02d}.png"
            image = render_mesh(mesh, pose, size, options.samples, light)
            write_image(out / "images" / name, image)
            entry: dict[str, object] = {
                "file_path": f"images/{name}",
                "frame": i,
                "camera": camera,
                "time": i / max(len(meshes) - 1, 1),
            }
            if options.scene_seed is not None:
                entry["depth_file_path"] = f"depth/{name}"
                depth = _depth_map(mesh, pose, size)
                write_image(out / "depth" / name, (depth / MILLIMETRE + 0.5).astype(np.uint16))
            entries.append(entry | {"transform_matrix": pose.tolist()})
    if not entries:
        return
    focal = _focal(size)
    lens = {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": 0.5 * size, "cy": 0.5 * size}
    write_text(
        out / f"transforms_{split}.json", json.dumps(lens | {"frames": entries}, indent=1) + "\n"
    )


def _depth_map(mesh: PosedMesh, world_from_cam: np.ndarray, size: int) -> np.ndarray:
    """Return the depth (S, S) along the view axis at pixel centres, m; 0 in the background."""
    image = _image_of(mesh.vertices, world_from_cam, size) - [0.5, 0.5, 0.0]
    fragments = rasterize(image[mesh.faces], size, size)
    depth = np.zeros(size * size)
    depth[fragments.index] = fragments.depth
    return depth.reshape(size, size)


def _posed_meshes(body: BodyTemplate, motion: Motion, paint: Paint) -> list[PosedMesh]:
    poses, trans, scale = (x.double() for x in (motion.poses, motion.trans, motion.scale))
    posed = posed_vertices(body.to(dtype=torch.float64), poses, trans, scale=scale).cpu().numpy()
    faces = body.faces.cpu().numpy()
    return [PosedMesh(vertices, faces, paint) for vertices in posed]


def ring_cameras(options: HumanOptions) -> np.ndarray:
    """Return the OpenGL poses (V, 4, 4), y up, of training and then test cameras on a ring."""
    count = options.num_cameras
    tests = np.arange(options.num_test) * count // max(options.num_test, 1)
    azimuths = 2 * np.pi / count * np.append(np.arange(count), tests + 0.5)
    radius = 3.5
    heights = np.where(np.arange(len(azimuths)) % 2 == 0, 0.9, 1.7)
    heights[count:] = 1.3
    if options.scene_seed is not None:
        generator = np.random.default_rng([options.scene_seed, 5])
        radius = generator.uniform(3.0, 4.2)
        heights = generator.uniform(0.7, 1.6) + generator.uniform(-0.08, 0.08, len(azimuths))
    centers = np.stack([radius * np.sin(azimuths), heights, radius * np.cos(azimuths)], axis=-1)
    backward = normalized(centers - [0.0, 0.95, 0.0])
    right = normalized(np.cross([0.0, 1.0, 0.0], backward))
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3] = np.stack([right, np.cross(backward, right), backward, centers], axis=-1)
    return poses


def _focal(size: int) -> float:
    return float(0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X))


PEOPLE_PER_FOLDER = 100
"""People per folder."""
_MAX_PEOPLE = 10**6  # per seed, so that people of different seeds never share a random seed


@dataclass(frozen=True)
class PeopleOptions:
    """Options of a set of synthetic people."""

    people: int = 100
    size: int = 256  # width and height of the images, px
    cameras: int = 24  # on a ring around each person
    frames: int = 1  # per person
    seed: int = 0  # different seeds share no body, outfit, motion, light or camera ring


def write_people(
    out: Path, options: PeopleOptions = PeopleOptions(), report: ProgressCallback = ignore_progress
) -> Path:
    """Write people as ``out/FOLDER/PERSON``, captures of ``write_human_capture`` with depth maps.

    Every person has their own body, outfit, motion, light and camera ring; every other one wears
    everyday clothes. Output is reproducible to the byte. If ``out`` holds people of the same
    options, missing ones are added, so that a set can be written in parts and used meanwhile.
    Raises DyngsError: options out of range, or a folder with other contents.
    """
    open_people_set(out, options)
    for number in range(options.people):
        person = out / f"s{number // PEOPLE_PER_FOLDER:04d}" / f"p{number:06d}"
        if not person.is_dir():
            write_human_capture(person, person_options(options, number))
        report("people", number + 1, options.people)
    return out


def open_people_set(out: Path, options: PeopleOptions) -> None:
    """Mark a new folder as a set of people of these options. Raises DyngsError: options out of
    range, or a folder with other contents."""
    least = min(options.people, options.size, options.cameras, options.frames, options.seed + 1)
    if least < 1 or options.people > _MAX_PEOPLE:
        raise DyngsError(
            "synthetic people need size, cameras and frames >= 1, seed >= 0, and 1 to "
            f"{_MAX_PEOPLE:,} people"
        )
    mark = out / PEOPLE_FILE
    made_with = {name: value for name, value in asdict(options).items() if name != "people"}
    text = json.dumps(made_with) + "\n"
    if not mark.is_file():
        require_new_folder(out)
        write_text(mark, text)
    elif mark.read_text(encoding="utf-8", errors="replace") != text:
        raise DyngsError(
            f"{out}: holds people with other options ({PEOPLE_FILE}); use a new folder or the "
            "same options"
        )


def person_options(options: PeopleOptions, number: int) -> HumanOptions:
    """Return the options of person ``number``, counted from 0."""
    seed = options.seed * _MAX_PEOPLE + number + 1  # 0 would be the bare template
    return HumanOptions(
        size=options.size,
        num_frames=options.frames,
        num_pose_frames=0,
        num_cameras=options.cameras,
        num_test=0,
        seed=seed,
        body_seed=seed,
        scene_seed=seed,
        everyday_clothes=number % 4 > 0,
        body_error=0.15,  # bodies of captures are estimates, too
    )
