"""Camera paths recorded in the viewer, in the format that ``dyngs render --path`` reads
(docs/camera_paths.md)."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dyngs.core.camera import Cameras
from dyngs.export.camera_paths import Keyframes, interpolate_keyframes, world_pose
from dyngs.io.formats.similarity import Similarity


@dataclass(frozen=True)
class Keyframe:
    """One camera, the time of the scene it shows, and the seconds until the next one."""

    camera: Cameras
    time: float | None
    seconds: float = 1.0


@dataclass(frozen=True)
class Recording:
    """Keyframes in their order; ``loops``: the camera returns to the first one at the end."""

    keyframes: tuple[Keyframe, ...] = ()
    loops: bool = False

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def duration(self) -> float:
        """Seconds of the path; those after the last keyframe count only in a loop."""
        return sum(key.seconds for key in self.keyframes[: None if self.loops else -1])

    def moved(self, how: Similarity) -> Recording:
        """Return the path that sees a scene that was moved as this one sees it before."""
        keys = (replace(key, camera=how.cameras(key.camera)) for key in self.keyframes)
        return replace(self, keyframes=tuple(keys))

    def starts(self) -> list[float]:
        """Return the second of each keyframe."""
        return np.concatenate(
            [[0.0], np.cumsum([key.seconds for key in self.keyframes[:-1]])]
        ).tolist()

    def document(self, size: tuple[int, int], fps: float, world_offset: np.ndarray) -> str:
        """Return the path as JSON, less ``world_offset``; focal lengths follow the height, px."""
        width, height = size
        keys: list[dict[str, Any]] = []
        for key, start in zip(self.keyframes, self.starts(), strict=True):
            pose = world_pose(key.camera.cam_from_world[0].double().cpu().numpy(), world_offset)
            focal = float(key.camera.intrinsics[0, 1, 1]) * height / key.camera.height
            entry: dict[str, Any] = {"at": start, "cam_from_world": pose.tolist(), "fl_x": focal}
            keys.append(entry if key.time is None else entry | {"time": key.time})
        document = {
            "width": width,
            "height": height,
            "fps": fps,
            "loop": self.loops,
            "keyframes": keys,
        }
        if self.loops:
            document["seconds"] = self.duration
        return json.dumps(document, indent=1) + "\n"

    def at(self, seconds: float) -> tuple[Cameras, float | None]:
        """Return the camera and the time of the scene after ``seconds`` of the path, of at least
        one keyframe."""
        first = self.keyframes[0].camera
        has_times = all(key.time is not None for key in self.keyframes)
        keys = Keyframes(
            np.stack(
                [key.camera.cam_from_world[0].double().cpu().numpy() for key in self.keyframes]
            ),
            np.stack([key.camera.intrinsics[0].double().cpu().numpy() for key in self.keyframes]),
            np.array(self.starts()),
            np.array([key.time for key in self.keyframes], np.float64) if has_times else None,
            self.duration if self.loops and len(self) > 1 else None,
        )
        made = interpolate_keyframes(keys, np.array([seconds]))
        pose, matrix = (
            first.cam_from_world.new_tensor(x) for x in (made.cam_from_world, made.intrinsics)
        )
        camera = replace(first, cam_from_world=pose, intrinsics=matrix)
        return camera, None if made.times is None else float(made.times[0])
