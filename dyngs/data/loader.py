"""Image loader: images of views as training targets, cached and prefetched in background
threads."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.geometry import scaled_intrinsics
from dyngs.data.images import maps as image_maps
from dyngs.data.images.images import (
    area_downscale,
    area_downscale_uint8,
    check_image,
    premultiply,
    read_image,
    read_mask,
    to_straight_uint8,
)
from dyngs.data.images.lens import LensMap, is_pinhole, undistort, undistort_map
from dyngs.data.read import view_size
from dyngs.ops.device import CPU, copy_async, gpu_memory

# A downscaled pixel is kept if the mean of the mask over its area reaches this value.
FULLY_KEPT = 1 - 1e-4

GPU_FRACTION = 0.25
"""Fraction of the free GPU memory for images; the scene and rendering need the rest."""

Decoded = dict[str, Tensor]
"""``pixels`` (H, W, 3 or 4) uint8 with straight alpha, ``mask`` (H, W) bool, and the maps of
``Image``, if present."""


def default_decoding_threads() -> int:
    """Return the number of decoding threads: one per two cores of this process, from one to
    four."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        cores = os.cpu_count() or 1
    return min(max(cores // 2, 1), 4)


@dataclass(frozen=True)
class Image:
    """An image with its camera, as a training target; fields that a view does not have are None.

    Attributes:
        name: name of the view.
        cameras: one pinhole camera (V = 1) of this image's size, float32.
        rgb_premultiplied: (H, W, 3) float32, colours times alpha.
        alpha: (H, W) float32 in [0, 1].
        mask: (H, W) float32, 1 = used in the loss, 0 = ignored; None if all pixels are used.
        time: in [0, 1].
        frame: frame number of the view.
        motion_mask: (H, W) float32, moving fraction of each pixel.
        depth: (H, W) float32 depth, 0 = unknown.
        flow: (H, W, 2) float32 displacement to the view ``flow_to`` in pixels of this image, NaN =
            unknown.
    """

    name: str
    cameras: Cameras
    rgb_premultiplied: Tensor
    alpha: Tensor | None
    mask: Tensor | None
    time: float | None
    frame: int | None = None
    motion_mask: Tensor | None = None
    depth: Tensor | None = None
    flow: Tensor | None = None

    def composite(self, background: Tensor) -> Tensor:
        """Return the (H, W, 3) image over the ``background`` colour (3,)."""
        if self.alpha is None:
            return self.rgb_premultiplied
        return self.rgb_premultiplied + (1 - self.alpha[..., None]) * background.to(
            self.alpha.device
        )

    def to(self, device: torch.device | str) -> Image:
        """Return a copy of the image and its camera on another device."""
        tensors: Any = {name: copy_async(x, device) for name, x in self.tensors().items()}
        return replace(self, cameras=self.cameras.to(device=device), **tensors)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that are not None, by name."""
        return {name: x for name, x in vars(self).items() if isinstance(x, Tensor)}

    def downscaled(self, factor: int) -> Image:
        """Return the image and its camera with both sides divided by ``factor`` (area average)."""
        if factor == 1:
            return self
        cameras = self.cameras.scaled(1 / factor)
        size = cameras.width, cameras.height
        small: Any = {}
        for name, values in self.tensors().items():
            if name == "flow":
                small[name] = image_maps.resize_flow(values, *size)
            elif name == "depth":
                small[name] = _nearest(values, image_maps.nearest_positions(*size))
            elif name == "rgb_premultiplied":
                small[name] = area_downscale(values, *size)
            else:
                small[name] = area_downscale(values[..., None], *size)[..., 0]
        if self.mask is not None:
            small["mask"] = (small["mask"] > FULLY_KEPT).float()
        return replace(self, cameras=cameras, **small)


class _ImageCache:
    """Images by view index and downscale factor, up to ``room`` bytes.

    Nothing is evicted when it is full: each image is requested once per epoch in random order, so
    the least recently used image is needed first.
    """

    def __init__(self, room: float) -> None:
        self.room = room
        self.images: dict[tuple[int, int], Any] = {}
        self.num_bytes = 0

    def keep(self, key: tuple[int, int], image: Decoded | Image, reserved: float) -> bool:
        """Add an image if it fits with ``reserved`` bytes to spare; return whether it fits."""
        size = _num_bytes(image)
        fits = self.num_bytes + size + reserved <= self.room
        if fits and key not in self.images:
            self.images[key] = image
            self.num_bytes += size
        return fits

    def drop(self, key: tuple[int, int]) -> None:
        """Remove an image if it is cached."""
        if key in self.images:
            self.num_bytes -= _num_bytes(self.images.pop(key))


def _num_bytes(image: Decoded | Image) -> int:
    tensors = image.tensors() if isinstance(image, Image) else image
    return sum(x.nbytes for x in tensors.values())


class ImageLoader:
    """A sequence of decoded images with a cache of up to ``options.cache_mb`` and prefetching.

    An index always returns the same bytes, whether cached, prefetched or not. Thread-safe. Images
    are decoded on the CPU; images on a GPU are cached in up to a quarter of its free memory.

    Attributes:
        views: the views, in the order of the images.
        times: times of the views in [0, 1] or None.
        camera_correction: returns the corrected camera of an image, given its index and the camera
            of the capture; None: no correction.
    """

    def __init__(
        self,
        views: Sequence[View],
        options: DataConfig | None = None,
        *,
        with_maps: bool = False,
        decoding_threads: int = 0,
    ) -> None:
        """Check all files (headers, not pixels), so that a bad capture fails before training
        starts.

        Args:
            views: one split of a capture.
            options: uses ``downscale``, ``longest_side`` and ``cache_mb``; None: defaults.
            with_maps: also read depth maps and flow.
            decoding_threads: threads for prefetching; unused if ``cache_mb`` is 0.
        """
        self.views = tuple(views)
        self.times = tuple(view.time for view in self.views)
        self.camera_correction: Callable[[int, Cameras], Cameras] | None = None
        self._options = options = options or DataConfig(root=Path())
        self._with_maps = with_maps
        self._device = CPU
        self._on_cpu = _ImageCache(options.cache_mb * 1e6)
        self._cache = self._on_cpu
        self._factor = 1
        self._threads = decoding_threads if options.cache_mb > 0 else 0
        self._pool: ThreadPoolExecutor | None = None
        self._pending: dict[int, Future[Decoded]] = {}
        self._last_map: tuple[object, LensMap] | None = None
        self._lock = Lock()
        self._waited_seconds = 0.0
        self._num_waited = 0
        check_files(self.views)

    def __len__(self) -> int:
        return len(self.views)

    @property
    def device(self) -> torch.device:
        """Device of the returned images and cameras."""
        return self._device

    @device.setter
    def device(self, device: torch.device) -> None:
        if device == self._device:
            return
        self.stop_prefetching()
        memory = gpu_memory(device)
        self._device = device
        self._cache = self._on_cpu
        if device != CPU:
            self._cache = _ImageCache(math.inf if memory is None else GPU_FRACTION * memory[0])

    def __getitem__(self, index: int) -> Image:
        index = range(len(self))[index]
        return self._given_out(index, self._as_stored(index))

    def downscaled(self, index: int, factor: int) -> Image:
        """Return ``self[index].downscaled(factor)``; cached for the last factor if memory
        allows."""
        key = (range(len(self))[index], factor)
        with self._lock:
            if factor != self._factor:
                for old in [key for key in self._cache.images if key[1] > 1]:
                    self._cache.drop(old)
                self._factor = factor
            small = self._cache.images.get(key) if factor > 1 else None
        if small is None:
            small = self._as_stored(key[0]).downscaled(factor)
            if factor > 1:
                with self._lock:
                    self._cache.keep(key, small, 0)
        return self._given_out(key[0], small)

    def _given_out(self, index: int, image: Image) -> Image:
        if self.camera_correction is not None:
            image = replace(image, cameras=self.camera_correction(index, image.cameras))
        return image if self._device == CPU else image.to(self._device)

    def _as_stored(self, index: int) -> Image:
        view = self.views[index]
        decoded = dict(self._decoded(index))
        pixels = premultiply(decoded.pop("pixels"))
        height, width = pixels.shape[:2]
        mask = decoded.pop("mask", None)
        return Image(
            name=view.name,
            cameras=_camera_of(view, width, height),
            rgb_premultiplied=pixels[..., :3].contiguous(),
            alpha=pixels[..., 3].contiguous() if pixels.shape[-1] == 4 else None,
            mask=None if mask is None else mask.float(),
            time=view.time,
            frame=view.frame,
            **decoded,
        )

    def cameras(self) -> list[Cameras]:
        """Return the (corrected) camera of each image; no image is read."""
        found = [_camera_of(view, *size) for view, size in zip(self.views, self.sizes, strict=True)]
        if self.camera_correction is not None:
            found = [self.camera_correction(i, cameras) for i, cameras in enumerate(found)]
        return [cameras.to(device=self.device) for cameras in found]

    def prefetch(self, indices: Sequence[int]) -> None:
        """Start decoding the images that are requested next, in this order, unless they are
        cached."""
        if not self._threads:
            return
        with self._lock:
            images = self._cache.images
            missing = [
                i
                for i in dict.fromkeys(indices)
                if (i, 1) not in images and (i, self._factor) not in images
            ][: 2 * self._threads]
            for index in self._pending.keys() - set(missing):
                self._pending.pop(index).cancel()
            if self._pool is None:
                self._pool = ThreadPoolExecutor(self._threads, "dyngs-images")
            for index in missing:
                if index not in self._pending:
                    self._pending[index] = self._pool.submit(self._on_demand, index)

    def stop_prefetching(self) -> None:
        """Stop the decoding threads; the next ``prefetch`` starts them again."""
        pool = self._pool
        self._pool = None
        self._pending = {}
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)

    def without_motion_masks(self) -> ImageLoader:
        """Return a loader of the same images without motion masks."""
        views = [replace(view, motion_mask_path=None) for view in self.views]
        return ImageLoader(
            views, self._options, with_maps=self._with_maps, decoding_threads=self._threads
        )

    @property
    def num_prefetched(self) -> int:
        """Number of images that ``prefetch`` decodes ahead; 0 if all are cached."""
        is_whole = all((i, 1) in self._cache.images for i in range(len(self)))
        return 0 if is_whole else 2 * self._threads

    @property
    def decoding_seconds(self) -> float:
        """Time in which requested images were decoded, if each one is decoded only once. 0 if the
        cache cannot hold all images."""
        return self._waited_seconds if self._bytes_of_all() <= self._cache.room else 0.0

    @property
    def decoding_seconds_left(self) -> float:
        """Expected time to decode the images that are not cached yet; 0 as ``decoding_seconds``."""
        pending = sum((i, 1) not in self._cache.images for i in range(len(self)))
        return pending * self.decoding_seconds / max(self._num_waited, 1)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of the images in px; no image is decoded."""
        return [view_size(view, self._options) for view in self.views]

    @property
    def pending_bytes(self) -> int:
        """Bytes of CPU memory that images will take in addition to those they take now."""
        every = min(self._bytes_of_all() - self.bytes_on_gpu, round(self._on_cpu.room))
        return max(every - self._on_cpu.num_bytes, 0)

    @property
    def bytes_on_gpu(self) -> int:
        """Bytes of GPU memory that images will take."""
        return 0 if self._device == CPU else int(min(self._bytes_of_all(), self._cache.room))

    def _bytes_of_all(self) -> int:
        """Return the bytes of all decoded images, assuming no alpha channel."""
        sizes = zip(self.views, self.sizes, strict=True)
        return sum(
            width * height * (3 + (view.mask_path is not None)) for view, (width, height) in sizes
        )

    def _decoded(self, index: int) -> Decoded:
        with self._lock:
            found = self._cache.images.get((index, 1))
            pending = self._pending.pop(index, None)
        if found is not None:
            return found
        begun = time.perf_counter()
        image = self._on_demand(index) if pending is None else pending.result()
        self._waited_seconds += time.perf_counter() - begun
        self._num_waited += 1
        found = {name: copy_async(x, self._device) for name, x in image.items()}
        size = _num_bytes(found)
        left = sum((i, 1) not in self._cache.images for i in range(len(self))) - 1
        waiting = min(2 * self._threads, left) * size
        # While images are shrunk, the small ones are what is requested; their values are floats.
        both = len(self) * size * (1 + 4 / self._factor**2)
        is_short = self._factor > 1 and both > self._cache.room
        with self._lock:
            if self._cache.keep((index, 1), found, math.inf if is_short else waiting):
                if self._cache is not self._on_cpu:
                    self._on_cpu.drop((index, 1))
            elif self._cache is not self._on_cpu:
                self._on_cpu.keep((index, 1), image, waiting)
        return found

    def _on_demand(self, index: int) -> Decoded:
        found = self._on_cpu.images.get((index, 1))
        return self._decode(self.views[index]) if found is None else found

    def _decode(self, view: View) -> Decoded:
        pixels = read_image(view.image_path, (view.width, view.height))
        if view.silhouette is not None:
            pixels = image_maps.apply_silhouette(pixels, view.silhouette)
        mask = None
        if view.mask_path is not None:
            mask = read_mask(view.mask_path)
            _require_size(view, view.mask_path, mask.shape, "mask")
        size = view_size(view, self._options)
        lens_map = None if is_pinhole(view.lens) else self._lens_map(view)
        if lens_map is not None:
            small = area_downscale(undistort(premultiply(pixels), lens_map), *size)
            pixels = to_straight_uint8(small)
            mask = _undistorted_mask(mask, lens_map)
        elif size != (view.width, view.height):
            pixels = area_downscale_uint8(pixels, *size)
        decoded = {"pixels": pixels, **self._maps(view, size, lens_map)}
        if mask is not None:
            # A pixel counts only if all that it covers is kept: otherwise masked colours would
            # bleed in.
            decoded["mask"] = area_downscale(mask.float()[..., None], *size)[..., 0] > FULLY_KEPT
        return decoded

    def _maps(self, view: View, size: tuple[int, int], lens_map: LensMap | None) -> Decoded:
        """Return the motion mask, depth and flow of a view, if present, resampled to ``size``."""
        maps: Decoded = {}

        def at_pixels(values: Tensor) -> Tensor:
            grid = None if lens_map is None else lens_map.grid
            return _nearest(values, image_maps.nearest_positions(*size, grid))

        if view.motion_mask_path is not None:
            read = image_maps.read_labels if view.motion_mask_labels else read_mask
            found = read(view.motion_mask_path)
            _require_size(view, view.motion_mask_path, found.shape, "motion mask")
            moves = (found != 0).float()[..., None]
            if lens_map is not None:
                moves = undistort(moves, lens_map)
            maps["motion_mask"] = area_downscale(moves, *size)[..., 0]
        if self._with_maps and view.depth_path is not None:
            maps["depth"] = view.depth_scale * at_pixels(image_maps.read_depth(view.depth_path))
            if lens_map is not None:
                positions = image_maps.nearest_positions(*size)
                maps["depth"] *= _nearest(lens_map.valid.float(), positions)
        if self._with_maps and view.flow_path is not None:
            flow = image_maps.read_flow(view.flow_path)
            _require_size(view, view.flow_path, flow.shape, "flow field")
            maps["flow"] = image_maps.flow_at(flow, view, size, lens_map)
        return maps

    def _lens_map(self, view: View) -> LensMap:
        """Return the undistortion map; only the last one is cached, as most captures have one
        camera."""
        key = (view.lens, view.intrinsics.tobytes(), view.width, view.height)
        last = self._last_map
        if last is None or last[0] != key:
            last = (key, undistort_map(view.lens, view.intrinsics, view.width, view.height))
            self._last_map = last
        return last[1]


def _camera_of(view: View, width: int, height: int) -> Cameras:
    """Return the camera of a view for an image of this size, without correction."""
    intrinsics = scaled_intrinsics(view.intrinsics, width / view.width, height / view.height)
    pose, intrinsics = (
        torch.as_tensor(x, dtype=torch.float32, device="cpu")[None]
        for x in (view.cam_from_world, intrinsics)
    )
    return Cameras(pose, intrinsics, width, height)


def check_files(views: Sequence[View]) -> None:
    """Check that all images and masks exist, look complete and have the size of their view."""
    for view in views:
        silhouette = view.silhouette and view.silhouette.path
        for path in (view.image_path, view.mask_path, silhouette):
            if path is not None and not path.is_file():
                more = ", or leave out views without images (data.skip_missing=true)"
                more = more if path == view.image_path else ""
                raise DyngsError(f"{path}: no such file; restore it{more}")
    for view in views:
        header = check_image(view.image_path)
        _require_size(
            view, view.image_path, header.size_matching((view.width, view.height))[::-1], "image"
        )
        if view.mask_path is not None:
            mask = check_image(view.mask_path)
            _require_size(view, view.mask_path, (mask.height, mask.width), "mask")


def _require_size(view: View, path: Path, shape: Sequence[int], what: str) -> None:
    height, width = shape[:2]
    if (width, height) != (view.width, view.height):
        raise DyngsError(
            f"{path}: the {what} is {width}x{height}, but its camera is "
            f"{view.width}x{view.height}; make them the same size"
        )


def _nearest(values: Tensor, positions: Tensor) -> Tensor:
    return image_maps.sample_nearest(values[..., None], positions)[..., 0]


def _undistorted_mask(mask: Tensor | None, lens_map: LensMap) -> Tensor | None:
    """Return the (H, W) bool mask of valid pixels with a fully kept neighbourhood; None if all are
    kept."""
    keep = lens_map.valid
    if mask is not None:
        keep = keep & (undistort(mask.float()[..., None], lens_map)[..., 0] > 0.999)
    return None if bool(keep.all()) else keep
