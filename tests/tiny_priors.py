"""A tiny capture with every kind of prior; its images are noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tiny_captures import edit_json, random_pixels, write_frames, write_image


def with_priors(root: Path, names: tuple[str, ...] = ("a", "b", "c")) -> Path:
    """A capture of one camera with every prior, and images of 12x8."""
    for i, name in enumerate(names):
        write_image(root / f"{name}.png", random_pixels(8, 12, 3, seed=i))
        write_image(root / f"{name}_moves.png", np.full((8, 12, 1), 255 * (i > 0), np.uint8))
        np.save(root / f"{name}_depth.npy", np.full((4, 6), 2.0 + i))
        np.save(root / f"{name}_flow.npy", np.full((8, 12, 2), 4.0))
    np.savez(
        root / "tracks.npz",
        xy=np.zeros((len(names), 1, 2)),
        visible=np.ones((len(names), 1)),
        names=np.array(names),
    )
    write_frames(
        root / "transforms_train.json",
        names,
        {"camera_angle_x": 0.7, "tracks_file_path": "tracks.npz"},
    )
    keys = {
        "motion_mask_path": "moves.png",
        "depth_file_path": "depth.npy",
        "flow_file_path": "flow.npy",
    }

    def change(content: dict) -> None:
        for i, frame in enumerate(content["frames"]):
            frame |= {"time": (2 - i) / 2} | {
                key: f"{names[i]}_{name}" for key, name in keys.items()
            }

    edit_json(root / "transforms_train.json", change)
    return root
