"""Colours near the outlines of estimated masks: the background is estimated and replaces the mask
there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, TrainConfig
from dyngs.data.capture import Capture, Silhouette, View
from dyngs.data.images.images import read_image
from dyngs.data.loader import ImageLoader
from dyngs.human.avatar.training import OutlineLoss, make_outline_loss
from dyngs.human.keys import HumanModel
from dyngs.io.write import write_image
from dyngs.models.kind import StartContext
from dyngs.models.model import LossInput, RenderOutput
from dyngs.models.renderable import Rendering

SIDE = 40
PLATE_FRAMES = 9
RED = (200.0, 20.0, 20.0)
GENERATOR = torch.Generator()


def behind() -> np.ndarray:
    """Return the background behind the person (H, W, 3) in grey levels."""
    return np.random.default_rng(3).integers(40, 160, (SIDE, SIDE, 3)).astype(np.float64)


def person(frame: int, grown: int = 0) -> np.ndarray:
    """Return where (H, W) a red square is in a frame, larger by ``grown`` px on all sides."""
    inside = np.zeros((SIDE, SIDE), bool)
    left = 4 + 3 * frame
    inside[10 - grown : 26 + grown, left - grown : left + 8 + grown] = True
    return inside


def views(folder: Path, grown: int, light: float = 0.0) -> list[View]:
    """Return views of the square, whose masks are too large by ``grown`` px; ``light`` grey levels
    come every frame."""
    found = []
    for frame in range(PLATE_FRAMES):
        photo = np.where(person(frame)[..., None], RED, behind() + light * frame)
        image = folder / f"{frame}.png"
        mask = folder / f"m{frame}.png"
        write_image(image, photo.clip(0, 255).round().astype(np.uint8))
        write_image(mask, (255 * person(frame, grown)).astype(np.uint8))
        pose = np.eye(4)
        intrinsics = np.array([[50.0, 0, 20], [0, 50, 20], [0, 0, 1]])
        view = View(f"{frame}", image, pose, intrinsics, SIDE, SIDE, time=frame / 8, frame=frame)
        found.append(replace(view, silhouette=Silhouette(mask, "white")))
    return found


def run(seen: list[View], background: str = "white", **train: Any) -> StartContext:
    config = Config(data=DataConfig(root=Path()), model=HumanModel(), train=TrainConfig(**train))
    capture = Capture(Path(), "body_json", {"train": tuple(seen)}, has_alpha=True)
    images = ImageLoader(seen)
    return StartContext(config, config, capture, images, background, 1.0, GENERATOR)


def loss_of(loss: OutlineLoss, seen: list[View], frame: int, alpha: Tensor, rgb: Tensor) -> Tensor:
    """Return the loss of a render with opacity (H, W) and colours (H, W, 3) before white."""
    image = ImageLoader(seen)[frame]
    rendered = alpha[..., None] * rgb + 1 - alpha[..., None]
    drawn = RenderOutput(Rendering(rendered[None], 1 - alpha[None], None), {}, {}, lambda: None)
    look = LossInput(
        frame, 1, image, drawn, rendered, image.composite(torch.ones(3)), cast(Any, None), GENERATOR
    )
    return loss(look)["image"]


@pytest.mark.parametrize("grown", [-1, 1])
def test_the_true_person_costs_least_though_the_mask_is_wrong(tmp_path: Path, grown: int) -> None:
    seen = views(tmp_path, grown)
    loss = make_outline_loss(run(seen))
    assert loss is not None
    alpha = torch.from_numpy(person(2)).float()
    rgb = torch.tensor(RED).expand(SIDE, SIDE, 3) / 255
    assert float(loss_of(loss, seen, 2, alpha, rgb)) < 1e-3
    crop_image = torch.from_numpy(person(2, grown)).float()
    assert float(loss_of(loss, seen, 2, crop_image, rgb)) > 5e-3


def test_crops_of_one_camera_share_its_background(tmp_path: Path) -> None:
    """Images that are cropped around the person have the background of whole images behind them."""
    seen = views(tmp_path, 1)
    cropped = []
    windows = []
    for frame, view in enumerate(seen):
        left = min(max(3 * frame - 5, 0), SIDE - 26)
        window = slice(3, 33), slice(left, left + 26)
        intrinsics = view.intrinsics.copy()
        intrinsics[:2, 2] -= [left, 3]
        files = {}
        for name, path in (("i", view.image_path), ("m", tmp_path / f"m{frame}.png")):
            files[name] = tmp_path / f"{name}c{frame}.png"
            write_image(files[name], read_image(path).numpy()[window])
        mask = Silhouette(files["m"], "white")
        crop = replace(view, image_path=files["i"], silhouette=mask, width=26, height=30)
        cropped.append(replace(crop, intrinsics=intrinsics))
        windows.append(window)
    whole, loss = make_outline_loss(run(seen)), make_outline_loss(run(cropped))
    assert whole is not None
    assert loss is not None
    for frame, (view, window) in enumerate(zip(cropped, windows, strict=True)):
        colours, known = loss.plates[0].window(frame, view.height, view.width)
        assert float(known.float().mean()) > 0.3
        truth = whole.plates[0].colours[window]
        assert float((colours - truth).abs()[known].max()) < 1e-6


def test_the_opacity_is_moved_towards_the_true_one(tmp_path: Path) -> None:
    """Of a pixel that the mask has and the person does not, opacity falls; far from the mask
    nothing is asked."""
    seen = views(tmp_path, 1)
    loss = make_outline_loss(run(seen))
    assert loss is not None
    alpha = (torch.from_numpy(person(2, 1)).float() * 0.9).requires_grad_()
    loss_of(loss, seen, 2, alpha, torch.tensor(RED).expand(SIDE, SIDE, 3) / 255).backward()
    assert alpha.grad is not None
    rim = torch.from_numpy(person(2, 1) & ~person(2))
    assert (
        float(alpha.grad[rim].mean())
        > 0
        > float(alpha.grad[torch.from_numpy(person(2, -2))].mean())
    )
