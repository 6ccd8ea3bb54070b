"""Smaller copies of the images of a capture, in folders ``images_2``, ``images_4``, .., and sizes in training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dyngs.config import DataConfig
from dyngs.data.capture import Splits, View, all_views, each_view
from dyngs.data.geometry import match_size
from dyngs.data.images.images import header_if_readable, target_size
from dyngs.files.find import FileFinder, shrunk_folders


def view_size(view: View, options: DataConfig) -> tuple[int, int]:
    """Return the (width, height) of a view in training."""
    return target_size(view.width, view.height, options.downscale / view.shrunk, options.longest_side)


def with_smaller_images(root: Path, splits: Splits, options: DataConfig) -> tuple[Splits, list[str]]:
    """Return views of the smallest copies that are large enough for training, and a line where there are copies."""
    images = root / "images"
    copies = shrunk_folders(images)
    views = [view for view in all_views(splits) if view.image_path.is_relative_to(images)]
    if not copies or not views:
        return splits, []
    names = ", ".join(copies[number].name for number in sorted(copies))
    factor = min(max(view.width, view.height) / max(view_size(view, options)) for view in views)
    fitting = [number for number in copies if number <= factor]
    if not fitting:
        hint = f"data.downscale={min(copies)} reads {copies[min(copies)].name}"
        return splits, [f"{names}: not read, because training takes larger images; {hint}"]
    folder = copies[max(fitting)]
    if any(view.mask_path or view.silhouette or view.depth_path or view.motion_mask_path for view in views):
        return splits, [f"{names}: not read, because masks and depth maps have the size of images"]
    finder = FileFinder(folder)
    paths = {view.name: finder.find(str(view.image_path.relative_to(images))) for view in views}
    found = {view.name: _shrunk(view, paths[view.name], max(fitting)) for view in views}
    small = {name: view for name, view in found.items() if view is not None}
    if len(small) < len(views):
        return splits, [
            f"{names}: not read, because {folder.name} lacks {len(views) - len(small)} of them at that size"
        ]
    smaller = each_view(splits, lambda view: small.get(view.name, view))
    return smaller, [f"{folder.name} is read in place of images: training takes images of that size or smaller ones"]


def _shrunk(view: View, path: Path, factor: int) -> View | None:
    """Return the view with a copy of its image that is ``factor`` times smaller; None where there is no such image."""
    header = header_if_readable(path)
    described = (view.width, view.height)
    stored = (0, 0) if header is None else header.size_for(described)
    if any(abs(factor * small - large) >= factor for small, large in zip(stored, described, strict=True)):
        return None
    intrinsics, size, _ = match_size(view.intrinsics, described, stored, str(path))
    return replace(view, image_path=path, intrinsics=intrinsics, width=size[0], height=size[1], shrunk=factor)
