"""Images of views in memory, decoded ahead in background threads."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Generic, TypeVar

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
    premultiplied,
    read_image,
    read_mask,
    straight_uint8,
)
from dyngs.data.images.lens import LensMap, is_pinhole, undistort, undistort_map
from dyngs.data.read import view_size
from dyngs.ops.device import CPU, Upload, gpu_memory, sent


@dataclass(frozen=True)
class Decoded:
    """Pixels (H, W, 3 or 4) uint8, straight alpha, mask (H, W) bool, and maps as those of
    ``Image``."""

    pixels: Tensor
    mask: Tensor | None
    moves: Tensor | None = None
    labels: Tensor | None = None
    depth: Tensor | None = None
    flow: Tensor | None = None

    @property
    def num_bytes(self) -> int:
        return sum(x.nbytes for x in self._there().values())

    def upload(self, device: torch.device) -> Callable[[], Decoded]:
        """Begin to copy everything to ``device``; the result returns the image there."""
        arrays = self._there()
        upload = Upload(list(arrays.values()), device)
        return lambda: replace(self, **dict(zip(arrays, upload.arrays(), strict=True)))

    def _there(self) -> dict[str, Tensor]:
        return {name: x for name, x in vars(self).items() if x is not None}


Item = TypeVar("Item")


class Ahead(Generic[Item]):
    """Results that ``threads`` work on in the background, 0: none; none of them depends on when
    that is done."""

    def __init__(self, work: Callable[[int], Item], threads: int) -> None:
        self._work, self._threads = work, threads
        self._pool: ThreadPoolExecutor | None = None
        self._pending: dict[int, Future[Item]] = {}
        self._process = os.getpid()

    @property
    def most(self) -> int:
        """Most items that are worked on, or wait to be taken: twice the number of threads."""
        return 2 * self._threads

    def expect(self, indices: Sequence[int]) -> None:
        """Begin to work on the first of ``indices``; what is no longer expected is dropped."""
        if not self._threads:
            return
        if self._process != os.getpid():  # threads do not survive a fork
            self._pool, self._pending, self._process = None, {}, os.getpid()
        expected = list(dict.fromkeys(indices))[: self.most]
        for index in set(self._pending) - set(expected):
            dropped = self._pending.pop(index, None)
            if dropped is not None:
                dropped.cancel()
        for index in expected:
            if index not in self._pending:
                if self._pool is None:
                    self._pool = ThreadPoolExecutor(
                        self._threads, thread_name_prefix="dyngs-images"
                    )
                # the context holds which files may be opened, and how large images may be
                self._pending[index] = self._pool.submit(copy_context().run, self._work, index)

    def rest(self) -> None:
        """End the threads, and drop what they have done; they begin anew when something is
        expected."""
        pool = self._pool
        self._pool = None
        self._pending = {}
        if pool is not None and self._process == os.getpid():
            pool.shutdown(wait=True, cancel_futures=True)

    def take(self, index: int) -> Item | None:
        """Return the item of ``index`` when it is ready, or raise what the work raised; None where
        not expected."""
        found = self._pending.pop(index, None)
        return None if found is None or self._process != os.getpid() else found.result()


def usual_threads() -> int:
    """Return how many threads work ahead: one for every two cores of this process, one to four."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        cores = os.cpu_count() or 1
    return min(max(cores // 2, 1), 4)


# mean of the mask over a shrunk pixel from which the whole pixel is kept; allows for rounding
FULLY_KEPT = 1 - 1e-4

GPU_FRACTION = 0.25
"""Fraction of the free memory of a GPU that images may take: the rest is for the scene and what is
drawn."""

_SMALL_BYTES = 4
"""Bytes of a shrunk image, whose values are float32, per byte of the whole one and fraction of its
pixels."""


@dataclass(frozen=True)
class Image:
    """The image of the view ``name`` with its camera, as a training target; what a view does not
    have is None.

    Attributes:
        cameras: one pinhole camera (V = 1) of this image's size, float32.
        rgb_premultiplied: (H, W, 3) float32, colours times alpha.
        alpha: (H, W) float32 in [0, 1].
        mask: (H, W) float32, 1 = counts in the loss, 0 = ignore; None where all pixels count.
        time: in [0, 1].
        frame: the view's frame number.
        moves: (H, W) float32, the fraction of each pixel that moves, by the motion mask.
        labels: (H, W) int64, which thing moves there, 0 for none; of a motion mask that tells them
            apart.
        depth: (H, W) float32 depth in the unit of its map, 0 where unknown.
        flow: (H, W, 2) float32 displacement in pixels of this image up to the view ``flow_to``, NaN
            where unknown.
    """

    name: str
    cameras: Cameras
    rgb_premultiplied: Tensor
    alpha: Tensor | None
    mask: Tensor | None
    time: float | None
    frame: int | None = None
    moves: Tensor | None = None
    labels: Tensor | None = None
    depth: Tensor | None = None
    flow: Tensor | None = None

    def composite(self, background: Tensor) -> Tensor:
        """Return the (H, W, 3) image over the colour ``background`` (3,)."""
        if self.alpha is None:
            return self.rgb_premultiplied
        return self.rgb_premultiplied + (1 - self.alpha[..., None]) * background.to(
            self.alpha.device
        )

    def to(self, device: torch.device | str) -> Image:
        """Return the same image, with its camera, on another device."""
        tensors: dict[str, Tensor] = {name: sent(x, device) for name, x in self._tensors().items()}
        return replace(self, cameras=self.cameras.to(device=device), **tensors)

    @property
    def num_bytes(self) -> int:
        return sum(x.nbytes for x in self._tensors().values())

    def _tensors(self) -> dict[str, Tensor]:
        return {name: x for name, x in vars(self).items() if isinstance(x, Tensor)}

    def shrunk(self, factor: int) -> Image:
        """Return the image with both sides divided by ``factor``, averaged over pixel areas, and
        its camera."""
        if factor == 1:
            return self
        cameras = self.cameras.scaled(1 / factor)
        width, height = cameras.width, cameras.height

        def mean(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return area_downscale(values[..., None], width, height)[..., 0]

        def nearest(values: Tensor | None) -> Tensor | None:
            if values is None:
                return None
            return _nearest(values, image_maps.nearest_positions(width, height))

        mask = mean(self.mask)
        return replace(
            self,
            cameras=cameras,
            rgb_premultiplied=area_downscale(self.rgb_premultiplied, width, height),
            alpha=mean(self.alpha),
            mask=None if mask is None else (mask > FULLY_KEPT).float(),
            moves=mean(self.moves),
            depth=nearest(self.depth),
            labels=nearest(self.labels),
            flow=None if self.flow is None else image_maps.resized(self.flow, width, height),
        )


class ImageLoader:
    """A sequence of images, decoded on demand or ahead of it; the first ones are cached up to
    ``options.cache_mb``.

    Once the cache is full, what is in it stays: where every image is requested once per epoch, in a
    new order each time, the one used last is the one needed last. The same index always gives the
    same bytes, cached or not, decoded ahead or not. Safe to use from several threads. Images are
    decoded on the CPU. Those given out on a GPU are kept there as far as a quarter of its free
    memory goes; the others are copied next to its work.

    Attributes:
        corrected: returns the camera of an image, given the index of its view and its camera by the
            capture; None: the latter.
    """

    def __init__(
        self,
        views: Sequence[View],
        options: DataConfig | None = None,
        *,
        with_maps: bool = False,
        decoding_threads: int = 0,
    ) -> None:
        """Check every file (not every pixel) at once, so that a bad capture fails before training
        starts.

        Args:
            views: one split of a capture.
            options: ``downscale``, ``longest_side`` and ``cache_mb`` count; None: the defaults.
            with_maps: read depth maps and flow, too.
            decoding_threads: decode what is to be expected in so many threads; none if ``cache_mb``
                is 0.
        """
        self._views = tuple(views)
        self._times = tuple(view.time for view in self._views)
        self._options = options = options or DataConfig(root=Path())
        self._with_maps = with_maps
        self._device, self._gpu_room = CPU, 0.0
        self._cache: dict[int, Decoded] = {}
        self._on_gpu: dict[int, Decoded] = {}
        self._cached_bytes = self._gpu_bytes = 0
        self._threads = decoding_threads if options.cache_mb > 0 else 0
        self._ahead = Ahead(self._made_ready, self._threads)
        self._small: dict[int, Image] = {}
        self._small_by, self._small_bytes = 1, 0
        self._last_map: tuple[object, LensMap] | None = None
        self._cameras: dict[tuple[int, int, torch.device], Cameras] = {}
        self.corrected: Callable[[int, Cameras], Cameras] | None = None
        self._lock = Lock()
        check_files(self._views)

    def __len__(self) -> int:
        return len(self._views)

    @property
    def device(self) -> torch.device:
        """Where images and cameras are given out."""
        return self._device

    @device.setter
    def device(self, device: torch.device) -> None:
        if device == self._device:
            return
        self.rest()
        memory = gpu_memory(device)
        with self._lock:
            self._on_gpu = {}
            self._gpu_bytes = 0
            self._small = {}
            self._small_bytes = 0
            self._device = device
            self._gpu_room = math.inf if memory is None else GPU_FRACTION * memory[0]

    @property
    def times(self) -> tuple[float | None, ...]:
        """Times of the views in [0, 1], None where a view has none."""
        return self._times

    @property
    def views(self) -> tuple[View, ...]:
        """The views, in the order of the images."""
        return self._views

    def __getitem__(self, index: int) -> Image:
        return self._with_camera(index, self._as_stored(index))

    def _with_camera(self, index: int, image: Image) -> Image:
        index %= len(self._views)
        if self.corrected is not None:
            image = replace(image, cameras=self.corrected(index, image.cameras))
        if self._device == CPU:
            return image
        if self.corrected is None:
            key = (index, image.cameras.width, self._device)  # sent once
            if key not in self._cameras:
                self._cameras[key] = image.cameras.to(device=self._device)
            image = replace(image, cameras=self._cameras[key])
        return image.to(self._device)

    def _as_stored(self, index: int) -> Image:
        view = self._views[index]
        decoded = self._decoded(index % len(self._views))
        height, width = decoded.pixels.shape[:2]
        pixels = premultiplied(decoded.pixels)
        return Image(
            name=view.name,
            cameras=self._camera(index % len(self._views), width, height),
            rgb_premultiplied=pixels[..., :3].contiguous(),
            alpha=pixels[..., 3].contiguous() if pixels.shape[-1] == 4 else None,
            mask=None if decoded.mask is None else decoded.mask.float(),
            time=view.time,
            frame=view.frame,
            moves=decoded.moves,
            labels=decoded.labels,
            depth=decoded.depth,
            flow=decoded.flow,
        )

    def _camera(self, index: int, width: int, height: int) -> Cameras:
        """Return the camera of a view, on the CPU; it is made once."""
        key = (index, width, CPU)
        if key not in self._cameras:
            self._cameras[key] = _camera_of(self._views[index], width, height)
        return self._cameras[key]

    def cameras(self) -> list[Cameras]:
        """Return the cameras of all images as they are by now, one each; no image is read."""
        found = [
            _camera_of(view, *size) for view, size in zip(self._views, self.sizes, strict=True)
        ]
        if self.corrected is not None:
            found = [self.corrected(i, cameras) for i, cameras in enumerate(found)]
        return [cameras.to(device=self.device) for cameras in found]

    def shrunk(self, index: int, factor: int) -> Image:
        """Return ``self[index].shrunk(factor)``; cached for the last factor, where memory is
        left."""
        with self._lock:
            if factor != self._small_by:
                self._small = {}
                self._small_by = factor
                self._small_bytes = 0
        if factor == 1:
            return self[index]
        index %= len(self._views)
        with self._lock:
            if index in self._small:
                return self._with_camera(index, self._small[index])
        image = self._as_stored(index).shrunk(factor)
        with self._lock:
            is_new = index not in self._small and factor == self._small_by
            if is_new and self._taken + image.num_bytes <= self._room:
                self._small[index] = image
                self._small_bytes += image.num_bytes
        return self._with_camera(index, image)

    def expect(self, indices: Sequence[int]) -> None:
        """Begin to decode the images that are requested next, in this order, as far as they are not
        cached."""
        with self._lock:
            missing = [
                i
                for i in indices
                if i not in self._kept and not (self._small_by > 1 and i in self._small)
            ]
        self._ahead.expect(missing)

    def rest(self) -> None:
        """End the threads that decode ahead; they begin anew with the next ``expect``."""
        self._ahead.rest()

    def without_motion_masks(self) -> ImageLoader:
        """Return a loader of the same images that reads no motion masks."""
        if all(view.motion_mask_path is None for view in self._views):
            return self
        views = [replace(view, motion_mask_path=None) for view in self._views]
        return ImageLoader(
            views, self._options, with_maps=self._with_maps, decoding_threads=self._threads
        )

    @property
    def decoded_ahead(self) -> int:
        """Number of images that ``expect`` decodes ahead; 0 where all are cached."""
        return 0 if len(self._kept) == len(self._views) else self._ahead.most

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of the images, in px, without decoding any."""
        return [view_size(view, self._options) for view in self._views]

    @property
    def bytes_to_come(self) -> int:
        """Bytes that images will take, in the cache or decoded ahead, next to those that they take
        now."""
        every = min(self._bytes_of_all() - self.bytes_on_gpu, round(self._options.cache_mb * 1e6))
        return max(every - self.cached_bytes, 0)

    @property
    def bytes_on_gpu(self) -> int:
        """Bytes that images will take of the memory of a GPU."""
        return 0 if self._device == CPU else int(min(self._bytes_of_all(), self._gpu_room))

    def _bytes_of_all(self) -> int:
        """Return the bytes of all images once decoded; whether a file has alpha is not known, and
        taken as no."""
        sizes = zip(self._views, self.sizes, strict=True)
        return sum(
            width * height * (3 + (view.mask_path is not None)) for view, (width, height) in sizes
        )

    @property
    def cached_bytes(self) -> int:
        """Bytes of the CPU's memory that cached images take."""
        return self._cached_bytes + (self._small_bytes if self._device == CPU else 0)

    @property
    def _kept(self) -> dict[int, Decoded]:
        return self._cache if self._device == CPU else self._on_gpu

    @property
    def _taken(self) -> int:
        """Bytes that are taken where images are given out, of ``_room``."""
        return self.cached_bytes if self._device == CPU else self._gpu_bytes + self._small_bytes

    @property
    def _room(self) -> float:
        return self._options.cache_mb * 1e6 if self._device == CPU else self._gpu_room

    def _decoded(self, index: int) -> Decoded:
        with self._lock:
            if index in self._kept:
                return self._kept[index]
        decoded, upload = self._ahead.take(index) or self._made_ready(index)
        there = decoded if upload is None else upload()
        with self._lock:
            self._keep(index, decoded, there)
        return there

    def _made_ready(self, index: int) -> tuple[Decoded, Callable[[], Decoded] | None]:
        """Return the decoded image ``index``, and its copy that is on its way to a GPU, if there is
        one."""
        with self._lock:
            decoded = self._cache.get(index)
        if decoded is None:
            decoded = self._decode(self._views[index])
        return decoded, None if self._device == CPU else decoded.upload(self._device)

    def _keep(self, index: int, decoded: Decoded, there: Decoded) -> None:
        """Keep an image where it is given out, if there is room; else, if that is a GPU, on the
        CPU."""
        if index not in self._kept and self._has_room(there.num_bytes):
            self._kept[index] = there
            if self._device == CPU:
                self._cached_bytes += there.num_bytes
                return
            self._gpu_bytes += there.num_bytes
            if self._cache.pop(index, None) is not None:
                self._cached_bytes -= decoded.num_bytes
        elif self._device != CPU and index not in self._on_gpu and index not in self._cache:
            waiting = (self._ahead.most + 1) * decoded.num_bytes
            if self._cached_bytes + waiting <= self._options.cache_mb * 1e6:
                self._cache[index] = decoded
                self._cached_bytes += decoded.num_bytes

    def _has_room(self, size: int) -> bool:
        """Return whether an image of ``size`` bytes is to be kept where it is given out.

        While images are shrunk, only where small and large ones fit together: the small ones are
        what is requested.
        """
        left = len(self._views) - len(self._kept) - 1
        if (
            self._small_by > 1
            and len(self._views) * size * (1 + _SMALL_BYTES / self._small_by**2) > self._room
        ):
            return False
        waiting = min(self._ahead.most, left) * size
        return self._taken + size + waiting <= self._room

    def _decode(self, view: View) -> Decoded:
        pixels = read_image(view.image_path, (view.width, view.height))
        if view.silhouette is not None:
            pixels = image_maps.cut_out(pixels, view.silhouette)
        mask = None
        if view.mask_path is not None:
            mask = read_mask(view.mask_path)
            _require_size(view, view.mask_path, mask.shape, "mask")
        size = view_size(view, self._options)
        maps = self._maps(view, size)
        if is_pinhole(view.lens) and size == (view.width, view.height):
            return Decoded(pixels, mask, **maps)
        if is_pinhole(view.lens):
            small = area_downscale_uint8(pixels, *size)
        else:
            lens_map = self._lens_map(view)
            small = straight_uint8(
                area_downscale(undistort(premultiplied(pixels), lens_map), *size)
            )
            mask = _undistorted_mask(mask, lens_map)
        if mask is not None:
            # A pixel counts only if all that it covers is kept: otherwise masked colours would
            # bleed in.
            mask = area_downscale(mask.float()[..., None], *size)[..., 0] > FULLY_KEPT
        return Decoded(small, mask, **maps)

    def _maps(self, view: View, size: tuple[int, int]) -> dict[str, Tensor]:
        """Return motion mask, depth and flow of a view, as far as it has them, for the image of
        ``size``."""
        maps: dict[str, Tensor] = {}
        lens_map = None if is_pinhole(view.lens) else self._lens_map(view)
        if view.motion_mask_path is not None:
            read = image_maps.read_labels if view.motion_mask_labels else read_mask
            found = read(view.motion_mask_path)
            _require_size(view, view.motion_mask_path, found.shape, "motion mask")
            if view.motion_mask_labels:
                positions = image_maps.nearest_positions(
                    *size, None if lens_map is None else lens_map.grid
                )
                maps["labels"] = _nearest(found, positions)
            moves = (found != 0).float()
            if lens_map is not None:
                moves = undistort(moves[..., None], lens_map)[..., 0]
            maps["moves"] = area_downscale(moves[..., None], *size)[..., 0]
        if self._with_maps and view.depth_path is not None:
            positions = image_maps.nearest_positions(
                *size, None if lens_map is None else lens_map.grid
            )
            maps["depth"] = view.depth_scale * _nearest(
                image_maps.read_depth(view.depth_path), positions
            )
            if lens_map is not None:
                maps["depth"] *= _nearest(
                    lens_map.valid.float(), image_maps.nearest_positions(*size)
                )
        if self._with_maps and view.flow_path is not None:
            flow = image_maps.read_flow(view.flow_path)
            _require_size(view, view.flow_path, flow.shape, "flow field")
            maps["flow"] = image_maps.flow_at(flow, view, size, lens_map)
        return maps

    def _lens_map(self, view: View) -> LensMap:
        """Return the undistortion map; only the last is cached: most captures have one camera, and
        maps are large."""
        key = (view.lens, view.intrinsics.tobytes(), view.width, view.height)
        last = self._last_map
        if last is None or last[0] != key:
            last = (key, undistort_map(view.lens, view.intrinsics, view.width, view.height))
            self._last_map = last
        return last[1]


def _camera_of(view: View, width: int, height: int) -> Cameras:
    """Return the camera of a view as an image of this size, by the capture."""
    intrinsics = scaled_intrinsics(view.intrinsics, width / view.width, height / view.height)
    pose, intrinsics = (
        torch.as_tensor(x, dtype=torch.float32, device="cpu")[None]
        for x in (view.cam_from_world, intrinsics)
    )
    return Cameras(pose, intrinsics, width, height)


def check_files(views: Sequence[View]) -> None:
    """Check that all images and masks of ``views`` exist, look complete and have the size of their
    view."""
    silhouettes = [view.silhouette.path for view in views if view.silhouette]
    paths = [
        path for view in views for path in (view.image_path, view.mask_path) if path is not None
    ] + silhouettes
    missing = next((path for path in paths if not path.is_file()), None)
    if missing is not None:
        is_image = any(view.image_path == missing for view in views)
        more = ", or leave out views without images (data.skip_missing=true)" if is_image else ""
        raise DyngsError(f"{missing}: no such file; restore it{more}")
    for view in views:
        header = check_image(view.image_path)
        if header.size_for((view.width, view.height)) != (view.width, view.height):
            raise DyngsError(
                f"{view.image_path}: the image is {header.width}x{header.height}, but {view.width}x{view.height} was "
                f"expected; restore the original or correct its intrinsics"
            )
        if view.mask_path is not None:
            mask = check_image(view.mask_path)
            _require_size(view, view.mask_path, (mask.height, mask.width), "mask")


def _require_size(view: View, path: Path, shape: Sequence[int], what: str) -> None:
    height, width = shape[:2]
    if (width, height) != (view.width, view.height):
        raise DyngsError(
            f"{path}: the {what} is {width}x{height} but its image is {view.width}x{view.height}; make them the same "
            "size"
        )


def _nearest(values: Tensor, positions: Tensor) -> Tensor:
    return image_maps.taken_at(values[..., None], positions)[..., 0]


def _undistorted_mask(mask: Tensor | None, lens_map: LensMap) -> Tensor | None:
    """(H, W) bool mask of pixels inside the stored image with a kept neighbourhood; None if all
    are."""
    keep = lens_map.valid
    if mask is not None:
        keep = keep & (undistort(mask.float()[..., None], lens_map)[..., 0] > 0.999)
    return None if bool(keep.all()) else keep
