"""Masks estimated in training exclude exactly the content that one image shows and the others do
not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from flat_wall import (
    BLACK,
    SIZE,
    cameras_before_wall,
    learned,
    places,
    seen_from,
    with_block,
    with_depth,
)
from torch import Tensor

from dyngs.config import Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.data.loader import Image
from dyngs.deform.keys import DynamicModel
from dyngs.models.model import RenderedView
from dyngs.models.renderable import Rendering
from dyngs.models.static_section import StaticModel
from dyngs.training.corrections.robust import WARM_UP, RobustMasks
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

COUNT, STEPS = 8, 100
AFTER = round(WARM_UP * STEPS) + 1
ROWS = slice(12, 42)
COLUMNS = slice(20, 44)


def masks_of(images: list[Image]) -> RobustMasks:
    return RobustMasks(images, [image.cameras for image in images], STEPS)  # type: ignore[arg-type]


def masked_images(
    images: list[Image], drawn: list[Tensor], masks: RobustMasks | None = None
) -> list[Image]:
    """Return all images after a round of training on them."""
    masks = masks or masks_of(images)
    pairs = zip(images, drawn, strict=True)
    return [masked(masks, i, AFTER, image, rgb) for i, (image, rgb) in enumerate(pairs)]


def masked(masks: RobustMasks, index: int, step: int, image: Image, rgb: Tensor) -> Image:
    """Return an image with the mask of its view in a step."""
    rendering = Rendering(rgb[None], torch.zeros(1, *rgb.shape[:2]), None)
    view = RenderedView(
        index, step, image, rendering, rgb, BLACK, lambda c, _: with_depth(c), lambda _: True
    )
    return masks.after_render(view).image


def busy_wall(which: tuple[int, ...] = (1, 4)) -> list[Image]:
    """Return images of the wall, some with a block in front."""
    images = seen_from(cameras_before_wall(COUNT))
    return [with_block(x, ROWS, COLUMNS) if i in which else x for i, x in enumerate(images)]


def test_occluders_of_some_views_are_masked() -> None:
    images = busy_wall()
    found = masked_images(images, [learned(image.cameras) for image in images])
    for i, image in enumerate(found):
        if i not in (1, 4):
            assert image.mask is None
            continue
        assert image.mask is not None
        assert not bool(image.mask[ROWS, COLUMNS].any())
        far = torch.ones(SIZE[1], SIZE[0], dtype=torch.bool)
        far[ROWS.start - 7 : ROWS.stop + 7, COLUMNS.start - 7 : COLUMNS.stop + 7] = False
        assert bool((image.mask[far] == 1).all())


def test_nothing_is_left_out_where_views_agree() -> None:
    images = busy_wall(())
    found = masked_images(images, [learned(image.cameras) for image in images])
    assert all(image.mask is None for image in found)


def test_regions_not_yet_learned_stay_in_the_loss() -> None:
    """A hole in the model errs as much as a passer-by, but there the other views look like the
    image."""
    images = busy_wall(())
    drawn = []
    for image in images:
        x, y = places(image.cameras)
        rgb = learned(image.cameras)
        rgb[((x - 0.5).square() + y.square()) < 0.5] = 0.0
        drawn.append(rgb)
    assert all(image.mask is None for image in masked_images(images, drawn))


def test_all_counts_while_the_run_warms_up() -> None:
    images = busy_wall()
    masks = masks_of(images)
    drawn = learned(images[1].cameras)
    assert masked(masks, 1, AFTER - 1, images[1], drawn) is images[1]


def test_the_images_own_mask_stays() -> None:
    own = torch.ones(SIZE[1], SIZE[0])
    own[:, :10] = 0
    images = [replace(image, mask=own) for image in busy_wall()]
    found = masked_images(images, [learned(image.cameras) for image in images])
    for i in (0, 1):
        mask = found[i].mask
        assert mask is not None
        assert not bool(mask[:, :10].any())
    assert not bool(found[1].mask[ROWS, COLUMNS].any())  # type: ignore[index]
    assert torch.equal(found[0].mask, own)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("visits", torch.zeros(3, dtype=torch.int64)),
        ("left_out", torch.full((COUNT, 40, 40), 7, dtype=torch.uint8)),
        ("histogram", torch.zeros(5, dtype=torch.float64)),
    ],
)
def test_a_state_of_other_images_is_refused(name: str, wrong: Tensor) -> None:
    masks = masks_of(busy_wall())
    with pytest.raises(ValueError, match=name):
        masks.load_state(masks.state() | {name: wrong})


def trainer_of(root: Path, choice: str, model: DynamicModel | None = None) -> Trainer:
    return build_trainer(
        Config(
            data=DataConfig(root=root),
            model=model or StaticModel(sh_degree=0),
            init=RandomInit(num_random=60),
            train=TrainConfig(steps=40, robust=choice),  # type: ignore[arg-type]
            run=RunConfig(threads=1),
        )
    )


def test_a_resumed_run_has_the_same_bytes(still: Path) -> None:
    whole, first, second = (trainer_of(still, "always") for _ in range(3))
    for _ in range(30):
        whole.step()
    for _ in range(15):
        first.step()
    second.restore(first.checkpoint())
    for _ in range(15):
        second.step()
    ends = whole.checkpoint().tensors, second.checkpoint().tensors
    assert ends[0].keys() == ends[1].keys()
    assert "robust.left_out" in ends[0]
    assert all(torch.equal(x, ends[1][name]) for name, x in ends[0].items())
