"""The fuzzed readers: every reader of untrusted files or text, with its seeds and the first use of
its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from program_captures import (
    write_metashape,
    write_odm,
    write_polycam,
    write_reality,
    write_record3d,
    write_shots,
)

from fuzz import seed_files as files
from fuzz.seeds import (
    Seed,
    write_blender,
    write_body_json,
    write_camera_folders,
    write_colmap_binary,
    write_colmap_text,
    write_llff,
    write_llff_videos,
    write_nerfstudio,
    write_neuman,
    write_neuman_aligned,
    write_people_snapshot,
    write_small_nerfies,
    write_zju,
    write_zju_single,
)

if TYPE_CHECKING:
    from dyngs.data.capture import Capture
    from dyngs.gaussians.rendering import Rendering
    from dyngs.gaussians.scene import GaussianScene
    from dyngs.human.body.body import BodyTemplate

Read = Callable[[Path], object]
"""Reads the input in a folder and uses it; returns values that must be finite."""


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        seeds: name to function that writes the seed.
        read: reads the folder.
        writes: whether the reader may write into the folder, as into a run folder.
        names_file: whether errors must name the file; those about arguments of the command line
            name the argument.
        needs: optional package without which the reader cannot run.
    """

    seeds: Mapping[str, Seed]
    read: Read
    writes: bool = False
    names_file: bool = True
    needs: str | None = None


def read_whole_capture(root: Path) -> object:
    """Read as ``dyngs data inspect --deep`` and ``dyngs train`` do: report, views, points, body,
    images."""
    from dyngs.capture.inspection import format_report, inspect_capture
    from dyngs.config import DataConfig
    from dyngs.core.errors import DyngsError
    from dyngs.data.loader import ImageLoader
    from dyngs.data.read import read_capture
    from dyngs.data.tracks import read_tracks
    from dyngs.human.motion.motion import captured_motion

    options = DataConfig.model_validate({"root": root})
    try:
        capture = read_capture(options)
    except DyngsError:
        report = inspect_capture(options, deep=True)
        if not report.problems:
            raise AssertionError("refused, but its report lists no problems") from None
        require_lines(format_report(report))
        raise
    require_lines(format_report(inspect_capture(options, deep=True)))
    views = capture.splits["train"]
    found: list[object] = [capture.points, capture.world_offset, *capture.splits.values()]
    if capture.body is not None:
        body = small_body(24)
        found += [
            captured_motion(root, own, capture.splits[split], body.joints)
            for split, own in capture.body.items()
            if capture.splits.get(split)
        ]
    if capture.tracks_path is not None:
        found.append(read_tracks(capture.tracks_path))
    loader = ImageLoader(views, options, with_maps=True)
    images = [loader[i] for i in range(min(len(loader), 2))]
    # NaN in flow means unknown.
    found += [p if p.flow is None else replace(p, flow=p.flow.nan_to_num(0.0)) for p in images]
    return found


def require_lines(report: str) -> None:
    """Check that no line of a report holds control characters."""
    bad = [
        line
        for line in report.splitlines()
        if any(ord(c) < 32 or 0x7F <= ord(c) < 0xA0 for c in line)
    ]
    assert not bad, f"control characters in a report: {bad[0]!r}"


def read_a_image(root: Path) -> object:
    """Read header and pixels of an image."""
    from dyngs.data.images.images import check_image, read_image

    path = only(root)
    return check_image(path), read_image(path)


def read_a_depth_map(root: Path) -> object:
    """Read a depth map, and the same file as labels where it is an image."""
    from dyngs.data.images.maps import read_depth, read_labels

    path = only(root)
    return read_depth(path), read_labels(path) if path.suffix == ".png" else None


def read_a_flow_field(root: Path) -> object:
    """Read optical flow; NaN in it is no failure: it means unknown."""
    from dyngs.data.images.maps import read_flow

    return read_flow(only(root)).nan_to_num(0.0)


def read_2d_tracks(root: Path) -> object:
    """Read 2D tracks."""
    from dyngs.data.tracks import read_tracks

    return read_tracks(only(root))


def read_a_video(root: Path) -> object:
    """Read size, length and first frames of a video."""
    from dyngs.data.images.video import probe_video, read_frames

    path = only(root)
    info = probe_video(path)
    return info, [frame for _, frame in zip(range(5), read_frames(path), strict=False)]


def read_a_pickle(root: Path) -> object:
    """Read a pickle; NaN in it is no failure, because its users check the numbers."""
    from dyngs.io.pickles import read_pickle

    read_pickle(only(root))
    return None


def read_a_body(root: Path) -> object:
    """Read a body template and pose it."""
    import torch

    from dyngs.human.body.body import posed_vertices
    from dyngs.human.body.body_reader import read_body

    uv = root / "uv.obj"
    body = read_body(
        next((p for p in sorted(root.iterdir()) if p.suffix in (".npz", ".pkl")), root / "a.npz"),
        uv if uv.is_file() else None,
    )
    poses = torch.full((1, len(body.joints), 3), 0.1)
    return body, posed_vertices(body, poses, torch.zeros(1, 3))


def read_a_motion(root: Path) -> object:
    """Read a motion and make it a clip on a small body."""
    from dyngs.human.motion.motion import motion_clip
    from dyngs.human.motion.retarget import read_motion

    motion = read_motion(only(root), small_body(55))
    return motion, motion_clip(motion).at(0.3)


def read_given_joints(root: Path) -> object:
    """Read 3D joints, for two images of a capture."""
    from dyngs.human.fit.keypoints import read_joints

    return read_joints(only(root), two_images(root))


def read_2d_key_points(root: Path) -> object:
    """Read key points of two images."""
    from dyngs.human.fit.keypoints import read_keypoints

    return read_keypoints(only(root), two_images(root).splits["train"])


def two_images(root: Path) -> Capture:
    """Return a capture of two views, whose images do not exist."""
    import numpy as np

    from dyngs.data.capture import Capture, View

    intrinsics = np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])
    views = [
        View(f"p{i}", root / f"p{i}.png", np.eye(4), intrinsics, 16, 12, frame=i) for i in range(2)
    ]
    return Capture(root, "x", {"train": tuple(views)})


def read_splats(root: Path) -> object:
    """Read a file of Gaussians, render it, and write it as another one."""
    from dyngs.gaussians.rendering import splat_options
    from dyngs.io.formats.formats import find_format, read_splats, write_splats

    path = next((p for p in sorted(root.iterdir()) if find_format(p) is not None), root / "a.ply")
    splat = read_splats(path)
    read_splats(path, nonfinite="skip")
    write_splats(root.parent / "out" / "b.ply", splat)
    return splat, drawn(splat.gaussians, replace(splat_options(splat), nonfinite="skip"))


def read_a_run(root: Path) -> object:
    """Read a run, and render it at two times."""
    from dyngs.runs.checkpoint import load_run, seconds_at

    run = load_run(root)
    return seconds_at(root, 7), run.info, played(run.scene, run.scene.options)


def read_a_person(root: Path) -> object:
    """Read an avatar and render it."""
    from dyngs.human.avatar.avatar_file import read_avatar

    _, scene, info = read_avatar(only(root))
    return info, played(scene, scene.options)


def read_a_preset(root: Path) -> object:
    """Read a configuration, and read it back after saving."""
    from dyngs.config.io import load_config, load_resolved, save_config

    config = load_config(only(root))
    save_config(config, root.parent / "out" / "config.yaml")
    load_resolved(root.parent / "out")
    return config.model_dump()


def read_override_lines(root: Path) -> object:
    """Read overrides of the command line into a configuration."""
    from dyngs.config.io import load_config, save_config

    config = load_config(None, words(root))
    save_config(config, root.parent / "out" / "config.yaml")
    return config.model_dump()


def read_a_path(root: Path) -> object:
    """Read a camera path."""
    from dyngs.export.camera_paths import read_path

    path = read_path(only(root))
    return path.cameras, path.fps, path.times


def read_a_point(root: Path) -> object:
    """The measurement and its row of the report."""
    from dyngs.study.measure import read_measurement
    from dyngs.study.tradeoff import build_rows

    measurement = read_measurement(only(root))
    return build_rows([measurement]), measurement


def read_option_values(root: Path) -> object:
    """Parse values of options of the command line."""
    from dyngs.data.times import parse_frames
    from dyngs.export.camera_paths import parse_times
    from dyngs.study.tradeoff import parse_variations

    parsers: tuple[Callable[[str], object], ...]
    parsers = (
        lambda word: parse_variations([word]),
        parse_frames,
        parse_times,
    )
    return [parse(word) for parse, word in zip(parsers, words(root), strict=False)]


def read_a_log(root: Path) -> object:
    """Read log and timing of an interrupted run, as resuming does."""
    from dyngs.runs.checkpoint import seconds_at
    from dyngs.runs.folder import LOG_NAME
    from dyngs.training.run_log import RunLog

    seconds = seconds_at(root, 7)
    with RunLog(root / LOG_NAME, 2):
        return seconds


def only(root: Path) -> Path:
    """Return the file of the folder that is named ``a``."""
    return next((path for path in sorted(root.iterdir()) if path.stem == "a"), root / "a")


def words(root: Path) -> list[str]:
    """Read arguments of a command line, one a line, with the escapes that Python uses."""
    return only(root).read_bytes().decode("utf-8", "surrogateescape").split("\n")


def drawn(gaussians: object, options: object) -> Rendering:
    """Render a small image of Gaussians."""
    from moving_scene import camera

    from dyngs.gaussians.rendering import render

    return render(gaussians, camera(8, 6), options)  # type: ignore[arg-type]


def played(scene: GaussianScene, options: object) -> object:
    """Render a scene at two times."""
    from moving_scene import camera

    return [scene.render(camera(8, 6), time, options=options) for time in (None, 0.6)]  # type: ignore[arg-type]


@cache
def small_body(joints: int) -> BodyTemplate:
    """Return a body with few vertices."""
    from motion_files import tiny_body

    return tiny_body(joints)


CAPTURES: dict[str, dict[str, Seed]] = {
    "blender": {"still": write_blender},
    "nerfstudio": {"moving": write_nerfstudio},
    "colmap": {"binary": write_colmap_binary, "text": write_colmap_text},
    "nerfies": {"nerfies": write_small_nerfies},
    "polycam": {"raw": write_polycam},
    "record3d": {"exported": write_record3d},
    "metashape": {"placed": partial(write_metashape, placement="component")},
    "realitycapture": {"registration": write_reality},
    "odm": {"reconstruction": write_odm, "shots": write_shots},
    "llff": {"still": write_llff, "videos": write_llff_videos},
    "camera_folders": {"mixed": write_camera_folders},
    "zju_mocap": {"annotated": write_zju, "single": write_zju_single},
    "neuman": {"fitted": write_neuman, "aligned": write_neuman_aligned},
    "body_json": {"smplx": write_body_json},
    "people_snapshot": {"video": write_people_snapshot},
}
"""Seeds of each capture format, by its name in ``dyngs.data.read.FORMATS``."""
_NEEDS = {"people_snapshot": "h5py"}
# USD is read in a process of its own, too slow for thousands of inputs.
_PACKED = ("compressed-ply", "spz", "splat", "sog", "glb")
_RUNS: dict[str, Seed] = {
    kind: partial(files.write_moving_runs, kind) for kind in ("hexplane", "mlp", "control_nodes")
}
_JOINTS: dict[str, Seed] = {
    "npz": files.write_joints_npz,
    "sam_3d_body": files.write_sam_3d_body,
}
_IMAGES: dict[str, Seed] = {
    "png": files.write_png,
    "png16": files.write_png16,
    "jpeg": files.write_jpeg,
}
_IMAGES |= {"exr": files.write_exr, "tiff": files.write_tiff}
_BODIES: dict[str, Seed] = {
    "npz": files.write_smpl_npz,
    "pickle": files.write_smpl_pickle,
    "uv": files.write_smplx_with_uv,
}

READERS: dict[str, Reader] = {
    **{
        name: Reader(seeds, read_whole_capture, needs=_NEEDS.get(name))
        for name, seeds in CAPTURES.items()
    },
    "images": Reader(_IMAGES, read_a_image),
    "depth": Reader({"png16": files.write_png16, "npz": files.write_depth_npz}, read_a_depth_map),
    "flow": Reader({"npy": files.write_flow_npy, "flo": files.write_flo}, read_a_flow_field),
    "tracks": Reader({"npz": files.write_tracks}, read_2d_tracks),
    "video": Reader({"mp4": files.write_mp4}, read_a_video),
    "pickles": Reader({"new": files.write_fits, "old": files.write_old_fits}, read_a_pickle),
    "bodies": Reader(_BODIES, read_a_body),
    "joints": Reader(_JOINTS, read_given_joints),
    "keypoints": Reader(
        {"openpose": files.write_openpose, "coco": files.write_coco}, read_2d_key_points
    ),
    "amass": Reader(
        {"smplh": files.write_smplh_motion, "own": files.write_own_motion}, read_a_motion
    ),
    "bvh": Reader({"walk": files.write_walk_bvh}, read_a_motion),
    "gltf": Reader({"linear": files.write_walk_glb, "cubic": files.write_cubic_glb}, read_a_motion),
    "ply": Reader({"splats": files.write_splats}, read_splats),
    **{
        name: Reader(
            {"splats": partial(files.write_packed, name)}, read_splats, needs=_NEEDS.get(name)
        )
        for name in _PACKED
    },
    "checkpoints": Reader({"still": files.write_still_run, **_RUNS}, read_a_run),
    "scenes": Reader(
        {"still": files.write_scene_file_still, "moving": files.write_scene_file_moving}, read_a_run
    ),
    "avatars": Reader({"person": files.write_person}, read_a_person),
    "presets": Reader({"preset": files.write_preset}, read_a_preset),
    "overrides": Reader({"lines": files.write_overrides}, read_override_lines, names_file=False),
    "camera_paths": Reader(
        {
            "frames": files.write_frames_path,
            "keyframes": files.write_keyframes,
            "nerfstudio": files.write_nerfstudio_path,
            "3dgs": files.write_3dgs_cameras,
        },
        read_a_path,
    ),
    "points": Reader({"point": files.write_measurement}, read_a_point),
    "options": Reader({"words": files.write_words}, read_option_values, names_file=False),
    "logs": Reader({"log": files.write_log}, read_a_log, writes=True),
}
"""Readers by their names on the command line."""
