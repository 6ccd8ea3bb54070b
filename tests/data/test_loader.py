from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import enumerate as enumerate_threads

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_gpu import GPU, pretend_gpu
from tiny_captures import random_pixels, write_image

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Lens, Silhouette, View
from dyngs.data.loader import ImageLoader


def views_of(
    root: Path, count: int = 3, channels: int = 4, size: tuple[int, int] = (12, 8)
) -> tuple[View, ...]:
    width, height = size
    intrinsics = np.array([[20.0, 0, 6.5], [0, 21.0, 3.5], [0, 0, 1]])
    views = []
    for i in range(count):
        path = root / f"{i}.png"
        write_image(path, random_pixels(height, width, channels, seed=i))
        views.append(View(str(i), path, np.eye(4), intrinsics, width, height))
    return tuple(views)


def loader(views: tuple[View, ...], **options: float) -> ImageLoader:
    return ImageLoader(views, DataConfig.model_validate({"root": ".", **options}))


@settings(max_examples=15, deadline=None)
@given(st.floats(1.0, 6.0), st.one_of(st.none(), st.integers(1, 20)))
def test_downscaled_compositing_and_intrinsics(
    tmp_path_factory: pytest.TempPathFactory, downscale: float, longest: int | None
) -> None:
    """Downscaling and compositing commute to 1/255; a ray through the image's corner stays the same
    ray."""
    root = tmp_path_factory.mktemp("views")
    view = views_of(root, 1)[0]
    options = {"downscale": downscale} | ({} if longest is None else {"longest_side": longest})
    small = loader((view,), **options)[0]
    background = torch.tensor([0.3, 0.6, 0.9])
    full = loader((view,))[0].composite(background)
    width = small.cameras.width
    height = small.cameras.height
    rows = torch.nn.functional.interpolate(
        full.permute(2, 0, 1)[None], (8 * height, 12 * width), mode="nearest"
    )
    wanted = torch.nn.functional.avg_pool2d(rows, (8, 12))[0].permute(1, 2, 0)
    torch.testing.assert_close(small.composite(background), wanted, rtol=0, atol=1 / 255)
    corner = torch.tensor([float(width), float(height), 1.0])
    ray = torch.linalg.solve(small.cameras.intrinsics[0], corner)
    wanted_ray = np.linalg.solve(view.intrinsics, [12.0, 8.0, 1.0])
    np.testing.assert_allclose(ray.numpy(), wanted_ray, rtol=1e-5)


def test_a_shrunk_image_is_the_mean_of_its_pixels(tmp_path: Path) -> None:
    """And its camera sees the same; what is masked anywhere in a pixel does not count."""
    image = loader(views_of(tmp_path))[0]
    mask = torch.ones(8, 12)
    mask[5, 3] = 0
    small = replace(image, mask=mask).downscaled(4)
    assert (small.cameras.width, small.cameras.height) == (3, 2)
    assert image.alpha is not None
    assert small.alpha is not None
    assert small.mask is not None
    torch.testing.assert_close(small.alpha, image.alpha.reshape(2, 4, 3, 4).mean((1, 3)))
    torch.testing.assert_close(
        small.rgb_premultiplied, image.rgb_premultiplied.reshape(2, 4, 3, 4, 3).mean((1, 3))
    )
    assert small.mask.tolist() == [[1, 1, 1], [0, 1, 1]]
    torch.testing.assert_close(
        small.cameras.intrinsics[0], torch.tensor([[5.0, 0, 1.625], [0, 5.25, 0.875], [0, 0, 1]])
    )
    assert image.downscaled(1) is image
    assert image.downscaled(100).rgb_premultiplied.shape == (1, 1, 3)


@pytest.mark.parametrize("cache_mb", [0, 1e-3, 1])
def test_shrunk_images_are_the_same_cached_or_not(cache_mb: float, tmp_path: Path) -> None:
    """The cache stays within its limit for all factors."""
    images = loader(views_of(tmp_path, 4), cache_mb=cache_mb)
    for factor in (4, 2, 1, 2):
        for i in (0, 1, 0, 3, -1):
            wanted = images[i].downscaled(factor)
            found = images.downscaled(i, factor)
            assert found.name == wanted.name
            assert torch.equal(found.rgb_premultiplied, wanted.rgb_premultiplied)
            assert torch.equal(found.cameras.intrinsics, wanted.cameras.intrinsics)
            assert images._on_cpu.num_bytes <= cache_mb * 1e6
    for i in range(4):
        (tmp_path / f"{i}.png").unlink()
    if cache_mb == 1:
        assert torch.equal(
            images.downscaled(0, 2).rgb_premultiplied, images[0].downscaled(2).rgb_premultiplied
        )


def test_same_bytes_cached_or_not_and_from_threads(tmp_path: Path) -> None:
    views = views_of(tmp_path, 4)
    views = tuple(replace(view, lens=Lens("opencv", (0.1, 0.0, 0.0, 0.0))) for view in views)
    cached = loader(views, downscale=1.5)
    uncached = loader(views, downscale=1.5, cache_mb=0)
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda i: cached[i % 4], range(16)))
    for i, image in enumerate(images):
        torch.testing.assert_close(
            image.rgb_premultiplied, uncached[i % 4].rgb_premultiplied, rtol=0, atol=0
        )


def test_cache_keeps_to_its_limit_and_what_is_in_it(tmp_path: Path) -> None:
    one = 8 * 12 * 4
    images = loader(views_of(tmp_path, 4), cache_mb=2.5 * one / 1e6)
    for i in (0, 1, 0, 2):
        images[i]
        assert images._on_cpu.num_bytes <= 2.5 * one
    for i in range(4):
        (tmp_path / f"{i}.png").unlink()
    images[0], images[1]
    with pytest.raises(DyngsError, match=r"2\.png"):
        images[2]


@pytest.mark.parametrize("cache_mb", [1e-3, 1])
def test_images_decoded_ahead_are_the_same(cache_mb: float, tmp_path: Path) -> None:
    """In any order, also one that was not foretold, and within the limit."""
    views = views_of(tmp_path, 6)
    options = DataConfig(root=Path(), cache_mb=cache_mb)
    ahead = ImageLoader(views, options, decoding_threads=2)
    plain = loader(views, cache_mb=0)
    for factor, order in (
        (2, (3, 1, 4, 0, 2, 5)),
        (1, (5, 0, 1, 2, 4, 3)),
        (1, (0, 1, 2, 3, 4, 5)),
    ):
        for position, index in enumerate(order):
            found = ahead.downscaled(index, factor)
            wanted = plain.downscaled(index, factor)
            assert torch.equal(found.rgb_premultiplied, wanted.rgb_premultiplied)
            ahead.prefetch((*order[position + 1 : position + 4], 0))
            assert ahead._on_cpu.num_bytes <= cache_mb * 1e6
    assert ahead.num_prefetched == (0 if cache_mb == 1 else 4)
    ahead.stop_prefetching()
    assert not [x for x in enumerate_threads() if x.name.startswith("dyngs-images")]


@pytest.mark.parametrize("free", [None, 4 * 2.5 * 8 * 12 * 4, 0])
@pytest.mark.parametrize("cache_mb", [1e-3, 1])
@pytest.mark.parametrize("threads", [0, 2])
def test_images_given_out_on_a_gpu_are_the_same(
    free: float | None,
    cache_mb: float,
    threads: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whether they are kept there, on the CPU, or nowhere; within both limits."""
    views = views_of(tmp_path, 6)
    monkeypatch.setattr(
        "dyngs.data.loader.gpu_memory", lambda _: None if free is None else (free, 0)
    )
    options = DataConfig(root=Path(), cache_mb=cache_mb)
    there = ImageLoader(views, options, decoding_threads=threads)
    plain = loader(views, cache_mb=0)
    with pretend_gpu():
        there.device = GPU
        for factor, order in (
            (2, (3, 1, 4, 0, 2, 5)),
            (1, (5, 0, 1, 2, 4, 3)),
            (1, (0, 1, 2, 3, 4, 5)),
        ):
            for position, index in enumerate(order):
                found = there.downscaled(index, factor)
                wanted = plain.downscaled(index, factor)
                assert found.rgb_premultiplied.device == found.cameras.intrinsics.device == GPU
                assert torch.equal(found.rgb_premultiplied.cpu(), wanted.rgb_premultiplied)
                there.prefetch((*order[position + 1 : position + 4], 0))
                assert there._on_cpu.num_bytes <= cache_mb * 1e6
                assert there._cache.num_bytes <= there._cache.room
        assert there.num_prefetched == (0 if free is None else 2 * threads)
        assert there.bytes_on_gpu == {None: 6 * 8 * 12 * 3, 0: 0}.get(free, int(2.5 * 8 * 12 * 4))


def test_mask_follows_the_image(tmp_path: Path) -> None:
    """A small pixel counts only if all that it covers counts."""
    keep = np.full((8, 12, 1), 255, np.uint8)
    keep[2, 5] = 0
    write_image(tmp_path / "mask.png", keep)
    view = replace(views_of(tmp_path, 1)[0], mask_path=tmp_path / "mask.png")
    mask = loader((view,))[0].mask
    assert mask is not None
    np.testing.assert_array_equal(mask.numpy(), keep[..., 0] / 255)
    small = loader((view,), downscale=2)[0].mask
    assert small is not None
    assert torch.nonzero(small == 0).tolist() == [[1, 2]]
    assert set(small.unique().tolist()) == {0.0, 1.0}


def test_missing_images_are_found_at_once(tmp_path: Path) -> None:
    views = views_of(tmp_path, 5)
    for i in (1, 3):
        (tmp_path / f"{i}.png").unlink()
    with pytest.raises(
        DyngsError,
        match=r"1\.png: no such file; restore it, or leave out .*data\.skip_missing=true",
    ):
        loader(views)


def test_sizes_that_disagree(tmp_path: Path) -> None:
    views = views_of(tmp_path, 1)
    with pytest.raises(DyngsError, match=r"0\.png: the image is 12x8, but its camera is 12x9"):
        loader((replace(views[0], height=9),))
    write_image(tmp_path / "mask.png", np.full((4, 4, 1), 255, np.uint8))
    with pytest.raises(DyngsError, match=r"mask\.png: the mask is 4x4"):
        # before an image is asked for
        loader((replace(views[0], mask_path=tmp_path / "mask.png"),))


def test_silhouettes_become_alpha(tmp_path: Path) -> None:
    person = np.zeros((8, 12, 1), np.uint8)
    person[2:4, 3:6] = 7
    write_image(tmp_path / "person.png", person)
    views = [
        replace(v, silhouette=Silhouette(tmp_path / "person.png", "nonzero"))
        for v in views_of(tmp_path, channels=3)
    ]
    alpha = loader(tuple(views))[1].alpha
    assert alpha is not None
    assert torch.equal(alpha, torch.from_numpy(person[..., 0] > 0).float())
    (tmp_path / "person.png").unlink()
    with pytest.raises(DyngsError, match=r"person\.png: no such file; restore it$"):
        loader(tuple(views))
