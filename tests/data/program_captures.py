"""Writers of tiny captures as phone apps and photogrammetry programs export them, by their
published definitions."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tiny_captures import FOCAL, opengl_pose, random_pixels, side_poses, write_image
from tiny_captures import HEIGHT as PHONE_HEIGHT
from tiny_captures import WIDTH as PHONE_WIDTH

WIDTH, HEIGHT = 48, 36
POINTS = np.array([[0.3, -0.2, 0.1], [-0.5, 0.4, 0.3], [0.1, 0.6, -0.4], [0.0, 0.0, 0.0]])
TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
POSES = [
    opengl_pose(0.7 * i) @ np.diag([-1.0, -1, 1, 1]) if i % 2 else opengl_pose(0.7 * i)
    for i in range(4)
]
"""OpenGL camera-to-world poses, every second one upside down."""
NAMES = [f"DSC_{i}.jpg" for i in range(4)]
PHONE_POSES = side_poses(4)


def write_photos(
    root: Path, names: Sequence[str] = NAMES, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> None:
    for i, name in enumerate(names):
        write_image(root / name, random_pixels(size[1], size[0], 3, seed=i))


def cv_from_world(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation from the world to the camera: x right, y down, z forward."""
    rotation = np.diag([1.0, -1, -1]) @ pose[:3, :3].T
    return rotation, -rotation @ pose[:3, 3]


# Metashape: the camera models of the user manual, appendix D.
METASHAPE = {
    "f": 40.0,
    "cx": 1.5,
    "cy": -0.75,
    "b1": 0.5,
    "k1": 0.05,
    "k2": -0.02,
    "k3": 0.004,
    "p1": 0.003,
    "p2": -0.002,
}


def write_metashape(
    root: Path,
    lens: dict[str, float] = METASHAPE,
    kind: str = "frame",
    placement: str | None = None,
    labels: Sequence[str] = NAMES,
    unaligned: Sequence[int] = (),
) -> Path:
    """Write cameras.xml; ``placement`` selects where the rotation, scale 1/3 and shift of the chunk
    are stored."""
    write_photos(root / "images")
    scale = 3.0
    shift = np.array([1.0, -2, 0.5])
    transform = (
        f"<transform><rotation>{' '.join(map(str, TURN.ravel()))}</rotation>"
        f"<translation>{' '.join(map(str, shift))}</translation><scale>{scale}</scale></transform>"
    )
    cameras = []
    for i, (label, pose) in enumerate(zip(labels, POSES, strict=True)):
        rotation, _ = cv_from_world(pose)
        local = np.eye(4)
        local[:3, :3] = rotation.T
        local[:3, 3] = pose[:3, 3]
        if placement is not None:  # world = scale * turn * local + shift
            local[:3, :3] = TURN.T @ rotation.T
            local[:3, 3] = TURN.T @ (pose[:3, 3] - shift) / scale
        numbers = " ".join(repr(float(x)) for x in local.ravel())
        inner = "" if i in unaligned else f"<transform>{numbers}</transform>"
        camera = f'<camera id="{i}" sensor_id="7" component_id="5" label="{label}">{inner}</camera>'
        cameras.append(f'<group label="second half">{camera}</group>' if i > 1 else camera)
    parameters = "".join(f"<{key}>{value}</{key}>" for key, value in lens.items())
    resolution = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    calibrations = (
        f'<calibration type="{kind}" class="initial">{resolution}<f>99</f></calibration>'
        f'<calibration type="{kind}" class="adjusted">{resolution}{parameters}</calibration>'
    )
    (root / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk '
        '1"><sensors next_id="8"><sensor id="7" label="X-T4" '
        f'type="{kind}">{resolution}{calibrations}</sensor></sensors><components><component '
        f'id="5">{transform if placement == "component" else ""}</component></components>'
        f"<cameras>{''.join(cameras)}</cameras>"
        f"{transform if placement == 'chunk' else ''}"
        "<settings></settings></chunk></document>"
    )
    return root


# RealityCapture: "XMP camera math" of its knowledge base, and the templates of its exports.
HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
NEWER_HEADER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
REALITY = {
    "f": 30.0,
    "px": 0.01,
    "py": -0.02,
    "k1": 0.04,
    "k2": -0.01,
    "k3": 0.002,
    "k4": 0.0,
    "t1": 0.002,
    "t2": -0.001,
}


def angles_of(pose: np.ndarray) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees: a camera that looks straight down, its top to the north,
    is rolled about its own y axis (the top), pitched about x (east), then turned clockwise, as seen
    from above, by its heading."""
    right, up, back = pose[:3, :3].T
    # The rows of the product of the three turns, solved for the angles by hand.
    pitch = math.asin(up[2])
    heading = math.atan2(up[0], up[1])
    roll = math.atan2(-right[2], back[2])
    return tuple(math.degrees(angle) for angle in (heading, pitch, roll))  # type: ignore[return-value]


def write_reality(root: Path, header: str = HEADER, folder: str = "images") -> Path:
    write_photos(root / folder)
    lines = [header]
    for name, pose in zip(NAMES, POSES, strict=True):
        numbers = [*pose[:3, 3], *angles_of(pose), *REALITY.values()]
        lines.append(",".join([name, *(repr(float(x)) for x in numbers)]))
    (root / "registration.csv").write_text("\n".join(lines) + "\n")
    return root


# ODM: OpenSfM's "camera models" and "geometric conventions".
ODM = {
    "projection_type": "brown",
    "width": WIDTH,
    "height": HEIGHT,
    "focal_x": 0.8,
    "focal_y": 0.82,
    "c_x": 0.01,
    "c_y": -0.02,
    "k1": 0.05,
    "k2": -0.01,
    "k3": 0.002,
    "p1": 0.001,
    "p2": -0.002,
}


def axis_angle(rotation: np.ndarray) -> list[float]:
    """The axis and angle of a rotation, by its eigenvector of eigenvalue 1."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    angle = math.acos(max(-1.0, min(1.0, (np.trace(rotation) - 1) / 2)))
    turned = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return (axis * angle * (1 if turned @ axis >= 0 else -1)).tolist()


def write_odm(root: Path, lens: dict[str, object] = ODM) -> Path:  # type: ignore[assignment]
    write_photos(root / "images")
    shots = {}
    for name, pose in zip(NAMES, POSES, strict=True):
        rotation, shift = cv_from_world(pose)
        shots[name] = {
            "rotation": axis_angle(rotation),
            "translation": shift.tolist(),
            "camera": "dji",
        }
    points = {
        str(i): {"coordinates": point.tolist(), "color": [i, 100.0, 200.0]}
        for i, point in enumerate(POINTS)
    }
    model = {"cameras": {"dji": lens}, "shots": shots, "points": points}
    small = {"cameras": {"dji": lens}, "shots": {"other.jpg": shots[NAMES[0]]}, "points": {}}
    (root / "opensfm").mkdir()
    (root / "opensfm" / "reconstruction.json").write_text(json.dumps([small, model]))
    (root / "cameras.json").write_text(json.dumps({"dji": lens}))
    return root


def write_shots(root: Path) -> Path:
    """``odm_report/shots.geojson`` instead of the reconstruction: it has the places of cameras."""
    write_odm(root)
    models = json.loads((root / "opensfm" / "reconstruction.json").read_text())
    (root / "opensfm" / "reconstruction.json").unlink()
    features = []
    for (name, shot), pose in zip(models[1]["shots"].items(), POSES, strict=True):
        own = {
            "filename": name,
            "rotation": shot["rotation"],
            "translation": pose[:3, 3].tolist(),
            "width": WIDTH,
        }
        features.append(
            {
                "type": "Feature",
                "properties": own,
                "geometry": {"type": "Point", "coordinates": [0, 0, 0]},
            }
        )
    (root / "odm_report").mkdir()
    (root / "odm_report" / "shots.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    return root


def write_polycam(root: Path, prefix: str = "corrected_", depth: bool = True) -> Path:
    """Names are times of capture, as in the app."""
    for i, pose in enumerate(PHONE_POSES):
        name = str(1_700_000_000 + i)
        write_image(
            root / "keyframes" / f"{prefix}images" / f"{name}.jpg",
            random_pixels(PHONE_HEIGHT, PHONE_WIDTH, 3, seed=i),
        )
        if depth:
            metres = np.full((3, 4, 1), 4000, np.uint16)
            write_image(root / "keyframes" / "depth" / f"{name}.png", metres)
        own = {
            f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)
        }
        own |= {
            "fx": FOCAL,
            "fy": FOCAL,
            "cx": 8.0,
            "cy": 6.0,
            "width": PHONE_WIDTH,
            "height": PHONE_HEIGHT,
            "blur_score": 80.0,
        }
        cameras = root / "keyframes" / f"{prefix}cameras"
        cameras.mkdir(parents=True, exist_ok=True)
        (cameras / f"{name}.json").write_text(json.dumps(own))
    return root


def quaternion(rotation: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation, from the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    return np.linalg.eigh(matrix / 3)[1][:, -1].tolist()


def write_record3d(
    root: Path, metadata: str = "metadata.json", images: str = "rgb", **more: object
) -> Path:
    numbers = [0, 1, 2, 10]  # so that the order of names is not that of numbers
    poses = [[0.0, 0, 0, 1, 0, 0, 0]] * 11
    for number, pose in zip(numbers, PHONE_POSES, strict=True):
        write_image(
            root / images / f"{number}.jpg",
            random_pixels(PHONE_HEIGHT, PHONE_WIDTH, 3, seed=number),
        )
        poses[number] = [*quaternion(pose[:3, :3]), *pose[:3, 3].tolist()]
    write_image(root / images / "10(1).jpg", random_pixels(PHONE_HEIGHT, PHONE_WIDTH, 3))
    fields = {
        "w": PHONE_WIDTH,
        "h": PHONE_HEIGHT,
        "fps": 60,
        "K": [FOCAL, 0, 0, 0, FOCAL, 0, 8.0, 6.0, 1],
        "poses": poses,
        **more,
    }
    (root / metadata).write_text(json.dumps(fields))
    return root
