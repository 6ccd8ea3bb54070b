"""Smaller copies of a capture's images, in ``images_2``, ``images_4``, ...; sizes of images in
training."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from dyngs.config import DataConfig
from dyngs.data.capture import Splits, View, all_views, each_view
from dyngs.data.geometry import match_size
from dyngs.data.images.images import header_if_readable, target_size
from dyngs.io.find import FileFinder, shrunk_folders


def view_size(view: View, options: DataConfig) -> tuple[int, int]:
    """Return the (width, height) of a view in training."""
    return target_size(
        view.width, view.height, options.downscale / view.shrunk, options.longest_side
    )


def with_smaller_images(
    root: Path, splits: Splits, options: DataConfig
) -> tuple[Splits, list[str]]:
    """Return views of the smallest copies that are large enough for training, and a line on what is
    read.

    Copies are not read where an image has no copy or has a mask or depth map, which have its size.
    """
    images = root / "images"
    copies = shrunk_folders(images)
    views = [view for view in all_views(splits) if view.image_path.is_relative_to(images)]
    if not copies or not views:
        return splits, []
    factor = min(max(view.width, view.height) / max(view_size(view, options)) for view in views)
    number = max((number for number in copies if number <= factor), default=min(copies))
    finder = FileFinder(copies[number])
    small: dict[str, View] = {}
    for view in views if number <= factor else ():
        copy = _shrunk(view, finder.find(os.path.relpath(view.image_path, images)), number)
        if copy is not None:
            small[view.name] = copy
    if len(small) < len(views):
        names = ", ".join(copies[key].name for key in sorted(copies))
        conditions = "if each image has its copy, and none a mask or a depth map"
        return splits, [
            f"{names}: not read; data.downscale={number} reads {copies[number].name} {conditions}"
        ]
    line = f"{copies[number].name} is read in place of images: training takes images of that size or smaller ones"
    return each_view(splits, lambda view: small.get(view.name, view)), [line]


def _shrunk(view: View, path: Path, factor: int) -> View | None:
    """Return the view with a copy of its image, ``factor`` times smaller; None if that cannot
    be."""
    if view.mask_path or view.silhouette or view.depth_path or view.motion_mask_path:
        return None
    header = header_if_readable(path)
    described = (view.width, view.height)
    stored = (0, 0) if header is None else header.size_for(described)
    if any(
        abs(factor * small - large) >= factor
        for small, large in zip(stored, described, strict=True)
    ):
        return None
    intrinsics, size, _ = match_size(view.intrinsics, described, stored, str(path))
    return replace(
        view, image_path=path, intrinsics=intrinsics, width=size[0], height=size[1], shrunk=factor
    )
