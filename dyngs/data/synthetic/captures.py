"""Captures of the embedded scenes, ray traced into the layout of NeRF-synthetic and D-NeRF, with
true tracks."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.raytrace import (
    CAMERA_ANGLE_X,
    Scene,
    is_seen,
    render_scene,
    render_things,
)
from dyngs.data.synthetic.scenes import SceneName, scene_at, still_life
from dyngs.data.tracks import TrueTracks, write_true_tracks
from dyngs.io.outputs import new_folder
from dyngs.io.write import write_image, write_text

CaptureStyle = Literal["teleport", "moving", "fixed"]
"""One camera somewhere else at each time, one that moves smoothly, or fixed ones that each take all
times."""

DISTANCE = 4.0
"""Of the cameras from the origin, world units."""
_FRONT_DEG = -45.0
_SECTOR_DEG = 64.0
"""Middle and range of the azimuths of fixed and moving cameras."""


@dataclass(frozen=True)
class ImageOptions:
    """Options of rendered images of ``size`` pixels a side, with ``samples`` per pixel side.

    Attributes:
        num_val, num_test: images that are held out.
        seed: rotates the training cameras; one seed gives the same bytes each time.
    """

    size: int = 128
    num_val: int = 0
    num_test: int = 8
    seed: int = 0
    samples: int = 3


@dataclass(frozen=True)
class StillOptions(ImageOptions):
    """Options of a capture of the static scene, with ``num_train`` training images."""

    num_train: int = 48


@dataclass(frozen=True)
class DynamicOptions(ImageOptions):
    """Options of a capture of a moving scene. The seed also assigns times to cameras.

    Test images lie at times between the training times, those of ``num_val`` are of one fixed
    camera; with fixed cameras both numbers only say whether there is a camera of that kind, which
    is never trained on.

    Attributes:
        num_times: training times, evenly spaced in [0, 1]; each fixed camera takes an image at
            each.
        num_cameras: fixed training cameras.
        style: how the scene is captured; None: ``room`` by fixed cameras, the others by one that
            teleports.
    """

    num_test: int = 12
    samples: int = 2
    num_times: int = 48
    num_cameras: int = 8
    style: CaptureStyle | None = None


@dataclass(frozen=True)
class Shot:
    """One image to render: its path below the root without suffix, the (4, 4) OpenGL pose, the
    time, a fixed camera."""

    name: str
    world_from_cam: np.ndarray
    time: float | None = None
    camera: int | None = None


def write_still_capture(out: Path, options: StillOptions = StillOptions()) -> Path:
    """Write images of ``still_life`` in the layout of the NeRF-synthetic scenes; returns ``out``.

    Files: ``transforms_SPLIT.json`` (OpenGL camera-to-world) and ``SPLIT/r_000.png`` (RGBA,
    straight alpha, sRGB) for every split with images. The folder appears when it is complete.
    Raises DyngsError: ``out`` holds something already, or cannot be written.
    """
    scene = still_life()
    splits = {
        "train": hemisphere_cameras(options.num_train, DISTANCE, options.seed),
        "val": orbit_cameras(options.num_val, DISTANCE, elevation_deg=45.0, start_deg=10.0),
        "test": orbit_cameras(options.num_test, DISTANCE, elevation_deg=28.0, start_deg=0.0),
    }
    with new_folder(out) as started:
        for split, poses in splits.items():
            shots = [Shot(f"{split}/r_{i:03d}", pose) for i, pose in enumerate(poses)]
            write_split(started, split, shots, lambda _: scene, options)
    return out


def write_dynamic_capture(
    name: SceneName, out: Path, options: DynamicOptions = DynamicOptions()
) -> Path:
    """Write images of the moving scene ``name`` in the layout of D-NeRF; returns ``out``.

    Files: ``transforms_SPLIT.json`` with ``time`` in [0, 1] per frame, and the images, RGBA with
    straight alpha, of ``room`` without alpha. Each time is seen by one camera somewhere else on the
    hemisphere, or by one on an arc, which a fixed camera in its middle tests. Fixed cameras each
    take all times: ``camAA/frame_BBBB.png``, frames with ``camera``; test and val have one camera
    each, never trained on.

    ``things/`` holds labels of what moves for each image (``render_things``), and
    ``true_tracks.npz`` the tracks of points on it (``TrueTracks``). Frames of val and test name
    their labels (``instance_mask_path``), those of train do not: training would take them as a
    prior. Raises DyngsError: no such scene, no images requested, ``out`` holds something already,
    or cannot be written.
    """
    scene_at(name, 0.0)
    if min(options.size, options.num_times, options.num_cameras, options.samples) < 1:
        raise DyngsError(
            "a synthetic capture needs size, num_times, num_cameras and samples of at least 1"
        )
    style = options.style or ("fixed" if name == "room" else "teleport")
    if name == "room" and style == "teleport":
        raise DyngsError(
            "the walls of the room would hide it from cameras all around; choose --style fixed or moving"
        )
    splits = _fixed_shots(options) if style == "fixed" else _single_shots(options, style)
    taken = [
        (shot.name, shot.time or 0.0, shot.world_from_cam)
        for shots in splits.values()
        for shot in shots
    ]
    with new_folder(out) as started:
        for split, shots in splits.items():
            write_split(
                started,
                split,
                shots,
                lambda shot: scene_at(name, shot.time or 0.0),
                options,
                name == "room",
            )
        write_true_tracks(
            started, true_tracks(lambda time: scene_at(name, time), taken, options.seed)
        )
    return out


def write_split(
    out: Path,
    split: str,
    shots: Sequence[Shot],
    scene_of: Callable[[Shot], Scene],
    options: ImageOptions,
    is_opaque: bool = False,
) -> None:
    if not shots:
        return
    frames = []
    for shot in shots:
        scene = scene_of(shot)
        rgba = render_scene(scene, shot.world_from_cam, options.size, options.samples)
        write_image(out / f"{shot.name}.png", rgba[..., :3] if is_opaque else rgba)
        frame: dict[str, object] = {"file_path": f"./{shot.name}"}
        if shot.camera is not None:
            frame["camera"] = shot.camera
        if shot.time is not None:
            frame["time"] = shot.time
            things = render_things(scene, shot.world_from_cam, options.size, options.samples)
            write_image(out / "things" / f"{shot.name}.png", things)
            if split != "train":
                frame["instance_mask_path"] = f"./things/{shot.name}.png"
        frames.append(frame | {"transform_matrix": shot.world_from_cam.tolist()})
    transforms = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    write_text(out / f"transforms_{split}.json", json.dumps(transforms, indent=1) + "\n")


def _single_shots(options: DynamicOptions, style: CaptureStyle) -> dict[str, list[Shot]]:
    """One image per training time, by cameras in random order or on a smooth arc; the validation
    camera is fixed.

    Test cameras lie on an orbit; a moving camera is tested by a fixed one in its middle.
    """
    random = np.random.default_rng(options.seed)
    count = options.num_test
    gaps = max(options.num_times - 1, 1)
    if style == "moving":
        count = min(count, gaps)
        middle_deg = _FRONT_DEG + random.uniform(-2.0, 2.0)
        along = np.array(_even_times(options.num_times)) - 0.5
        train = _poses(
            DISTANCE,
            middle_deg + _SECTOR_DEG * along,
            20.0 + 5.0 * np.sin(2 * np.pi * along),
        )
        fixed = _poses(DISTANCE, np.array([middle_deg]), np.array([28.0]))
        test = np.repeat(fixed, count, axis=0)
    else:
        train = hemisphere_cameras(options.num_times, DISTANCE, options.seed)
        train = random.permutation(train)  # the spiral climbs: time would tell the height
        test = orbit_cameras(count, DISTANCE, elevation_deg=28.0, start_deg=-60.0)
        fixed = orbit_cameras(1, DISTANCE, elevation_deg=28.0, start_deg=-60.0)
    poses = {"train": train, "val": np.repeat(fixed, options.num_val, axis=0), "test": test}
    times = {
        "train": _even_times(options.num_times),
        "val": _even_times(options.num_val),
        # spread over [0, 1], each midway between two neighbours of the training times
        "test": [(int((i + 0.5) * gaps / count) + 0.5) / gaps for i in range(count)],
    }
    return {
        split: [
            Shot(f"{split}/r_{i:03d}", pose, time)
            for i, (pose, time) in enumerate(zip(own, times[split], strict=True))
        ]
        for split, own in poses.items()
    }


def _fixed_shots(options: DynamicOptions) -> dict[str, list[Shot]]:
    """Fixed cameras on an arc in front, low and high in turn; the test camera in the middle of the
    arc."""
    count = options.num_cameras
    shift = np.random.default_rng(options.seed).uniform(-2.0, 2.0)
    azimuths_deg = _FRONT_DEG + shift + _SECTOR_DEG * ((np.arange(count) + 0.5) / count - 0.5)
    elevations_deg = np.where(np.arange(count) % 2 == 0, 16.0, 28.0)
    middle = _FRONT_DEG + shift + (0.5 * _SECTOR_DEG / count if count % 2 else 0.0)
    azimuths_deg = np.append(azimuths_deg, [middle, middle])
    elevations_deg = np.append(elevations_deg, [22.0, 34.0])
    poses = _poses(DISTANCE, azimuths_deg, elevations_deg)
    cameras = {
        "train": range(count),
        "val": (count + 1,) if options.num_val else (),
        "test": (count,) if options.num_test else (),
    }
    return {
        split: [
            Shot(f"cam{camera:02d}/frame_{i:04d}", poses[camera], time, camera)
            for i, time in enumerate(_even_times(options.num_times))
            for camera in cameras[split]
        ]
        for split in cameras
    }


def _even_times(count: int) -> list[float]:
    return [i / max(count - 1, 1) for i in range(count)]


def hemisphere_cameras(count: int, distance: float, seed: int) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses spread evenly over the upper hemisphere, looking
    at the origin.

    A Fibonacci spiral from 6 to 80 degrees of elevation, rotated by a random azimuth.
    """
    turn = np.random.default_rng(seed).uniform(0.0, 2 * np.pi)
    fraction = (np.arange(count) + 0.5) / max(count, 1)
    heights = np.sin(np.radians(6.0)) * (1 - fraction) + np.sin(np.radians(80.0)) * fraction
    azimuths = turn + np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return _look_at_origin(distance, azimuths, np.arcsin(heights))


def orbit_cameras(
    count: int, distance: float, elevation_deg: float, start_deg: float
) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses on a level circle around the origin."""
    azimuths = np.radians(start_deg) + 2 * np.pi * np.arange(count) / max(count, 1)
    return _look_at_origin(distance, azimuths, np.full(count, np.radians(elevation_deg)))


def _poses(distance: float, azimuths_deg: np.ndarray, elevations_deg: np.ndarray) -> np.ndarray:
    return _look_at_origin(distance, np.radians(azimuths_deg), np.radians(elevations_deg))


def _look_at_origin(distance: float, azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """(V, 4, 4) OpenGL camera-to-world poses, z up; angles (V,) in radians."""
    cos_e = np.cos(elevations)
    sin_e = np.sin(elevations)
    cos_a = np.cos(azimuths)
    sin_a = np.sin(azimuths)
    backward = np.stack([cos_e * cos_a, cos_e * sin_a, sin_e], axis=-1)
    right = np.stack([-sin_a, cos_a, np.zeros_like(sin_a)], axis=-1)
    poses = np.tile(np.eye(4), (len(azimuths), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = right, np.cross(backward, right), backward
    poses[:, :3, 3] = distance * backward
    return poses


POINTS_PER_THING = 200


def true_tracks(
    scene_of: Callable[[float], Scene],
    shots: Sequence[tuple[str, float, np.ndarray]],
    seed: int = 0,
) -> TrueTracks:
    """Return the tracks of points spread over all that moves in the scene at a time in [0, 1].

    ``shots``: name, time, and (4, 4) OpenGL camera-to-world pose of each view; ``seed``: of the
    points.
    """
    times = sorted({time for _, time, _ in shots})
    scenes = {time: scene_of(time) for time in times}
    first = scenes[times[0]]
    random = np.random.default_rng(seed)
    local = {i: first.primitives[i].sampled(POINTS_PER_THING, random) for i in first.movers}
    points = {time: _placed(scenes[time], local) for time in times}
    visible = [
        is_in_image(points[time], pose) & is_seen(scenes[time], points[time], pose)
        for _, time, pose in shots
    ]
    return TrueTracks(
        np.stack([points[time] for time in times]),
        np.array(times, np.float64),
        np.array([name for name, _, _ in shots]),
        np.array([times.index(time) for _, time, _ in shots], np.int64),
        np.stack(visible),
    )


def is_in_image(points: np.ndarray, world_from_cam: np.ndarray) -> np.ndarray:
    """(P,) bool: points (P, 3) before the camera and within its square image; NaN is not."""
    x, y, z = ((np.nan_to_num(points) - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    reach = np.tan(0.5 * CAMERA_ANGLE_X) * -z
    return np.isfinite(points).all(axis=1) & (z < 0) & (np.abs(x) < reach) & (np.abs(y) < reach)


def _placed(scene: Scene, local: dict[int, np.ndarray]) -> np.ndarray:
    """(P, 3) float32 of points on the primitives of ``scene``."""
    return np.concatenate([scene.primitives[i].placed(x) for i, x in local.items()]).astype(
        np.float32
    )
