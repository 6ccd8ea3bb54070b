"""One capture of several videos: images, a COLMAP model with a pose for each, and their seconds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dyngs.capture.multi_video.camera_poses import camera_name
from dyngs.capture.multi_video.films import Film
from dyngs.capture.multi_video.given import NAME
from dyngs.conventions import ReportProgress
from dyngs.data.images.video import read_numbered_frames
from dyngs.data.readers.colmap import TEST_LIST
from dyngs.data.times import Taken, write_seconds
from dyngs.files.write import write_image, write_text

if TYPE_CHECKING:
    import pycolmap


def write_images(root: Path, films: Sequence[Film], taken: Sequence[Taken], report: ReportProgress) -> list[list[str]]:
    """Write the frames as ``root/images/CAMERA/frame_NNNNN.png``; return their names below ``images`` by camera.

    Raises:
        DyngsError: damage in a video, or the folder cannot be written.
    """
    total, done = sum(len(frames.numbers) for frames in taken), 0
    names: list[list[str]] = []
    for film, frames in zip(films, taken, strict=True):
        own = []
        for number, rgb in read_numbered_frames(film.path, [int(number) for number in frames.numbers]):
            own.append(f"{film.name}/frame_{number:05d}.png")
            write_image(root / "images" / own[-1], rgb)
            done += 1
            report("frames of the videos", done, total)
        names.append(own)
    return names


def write_model(
    root: Path, films: Sequence[Film], names: Sequence[Sequence[str]], standing: pycolmap.Reconstruction
) -> None:
    """Write ``root/sparse/0``: a lens for each camera, its one pose for all its images, and the points.

    The first image of each camera has the observations of the points.

    Args:
        root: the capture.
        films: the videos.
        names: images of each.
        standing: poses, one image for each camera.
    """
    import pycolmap

    whole = pycolmap.Reconstruction()
    posed = {camera_name(image): image for image in standing.images.values() if image.has_pose}
    first_ids: dict[int, int] = {}
    image_id = 0
    for number, (film, own) in enumerate(zip(films, names, strict=True)):
        image = posed[film.name]
        lens = standing.cameras[image.camera_id]
        camera = pycolmap.Camera(
            camera_id=number + 1, model=lens.model, width=lens.width, height=lens.height, params=lens.params
        )
        whole.add_camera_with_trivial_rig(camera)
        places = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        for place, name in enumerate(own):
            image_id += 1
            seen = places if place == 0 else np.zeros((0, 2))
            new = pycolmap.Image(name=name, keypoints=seen, camera_id=number + 1, image_id=image_id)
            whole.add_image_with_trivial_frame(new, image.cam_from_world())
        first_ids[image.image_id] = image_id - len(own) + 1
    for number in sorted(standing.points3D):
        point = standing.points3D[number]
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in first_ids:
                track.add_element(first_ids[element.image_id], element.point2D_idx)
        whole.add_point3D(point.xyz, track, point.color)
    whole.update_point_3d_errors()
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    whole.write(folder)


def write_facts(root: Path, seconds: Mapping[str, float], starts: Mapping[str, float], test: Sequence[str]) -> None:
    """Write the seconds of the images, which of them are for testing, and when each video begins.

    Args:
        root: the capture.
        seconds: image below ``images`` to the second at which it was taken, in the clock of all videos.
        starts: camera to the second at which its video begins.
        test: cameras that are held out.
    """
    write_seconds(root, {name: round(second, 6) for name, second in seconds.items()})
    held_out = [name for name in seconds if name.partition("/")[0] in test]
    if held_out:
        write_text(root / "sparse" / "0" / TEST_LIST, "".join(f"{name}\n" for name in held_out))
    rounded = {name: round(start, 6) for name, start in starts.items()}
    write_text(root / NAME, json.dumps({"starts": rounded, "test": list(test)}, indent=1) + "\n")
