"""Quality and speed of variants, measured by rendering them, and files of that, so that nothing is
measured twice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean

from pydantic import TypeAdapter
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.core.metrics import Lpips, psnr, ssim
from dyngs.core.section import ModelSection
from dyngs.data.loader import Image
from dyngs.evaluate.view_scores import Drawing
from dyngs.models.renderable import Renderable
from dyngs.study.speed import Speed
from dyngs.study.stored import AS_STORED, read_stored, write_stored
from dyngs.study.tradeoff.variants import Variant


@dataclass(frozen=True)
class Measurement:
    """Quality, size and speed of a variant.

    Attributes:
        psnr, ssim, lpips: means over the views; LPIPS is None where it cannot be computed.
        num_gaussians: of curved triangles theirs.
        mb: 1e6 bytes on disk: the .dyngs file, or 4 bytes per value needed for rendering where
            nothing is quantised.
        memory_mb: largest growth of a process that loads and renders the variant, 1e6 bytes; None
            where unknown.
        speed: None until it is measured.
    """

    __pydantic_config__ = AS_STORED
    variant: Variant
    num_views: int
    psnr: float
    ssim: float
    lpips: float | None
    num_gaussians: int
    mb: float
    memory_mb: float | None
    speed: Speed | None = None

    @property
    def gain(self) -> float:
        """Median speed relative to the run itself; 1 until it is measured."""
        return 1.0 if self.speed is None else self.speed.gain.median


_STORED = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    return read_stored(path, _STORED, "measurement of a variant")


def write_measurement(path: Path, measurement: Measurement) -> None:
    write_stored(path, asdict(measurement) | {"variant": measurement.variant.changes})


def pareto_mask(goals: Sequence[Sequence[float]]) -> list[bool]:
    """Return which points are on the Pareto front: no other is as good in all goals and better in
    one."""
    return [not any(_dominates(other, own) for other in goals) for own in goals]


def on_front(measurements: Sequence[Measurement]) -> list[bool]:
    """Return which variants are on the Pareto front of PSNR, speed and size."""
    return pareto_mask([(m.psnr, m.gain, -m.mb) for m in measurements])


def _dominates(a: Sequence[float], b: Sequence[float]) -> bool:
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(
        x > y for x, y in zip(a, b, strict=True)
    )


def with_render_settings(variant: Variant, model: ModelSection) -> ModelSection:
    """Return the ``model`` section of a run with the render settings of a variant."""
    changes = {
        "rasterize_mode" if name == "mode" else name: value for name, value in variant.drawn.items()
    }
    return model.model_copy(update=changes)


def variant_drawing(variant: Variant, scene: Renderable, background: Tensor) -> Drawing:
    """Return the scene of a variant as it is drawn."""
    return Drawing(scene, replace(scene.options, **variant.drawn), background, variant.scale)


def measure_quality(
    drawing: Drawing, images: Iterable[Image], lpips: Lpips
) -> tuple[float, float, float | None]:
    """Return mean PSNR, SSIM and LPIPS (None where unknown) over images, each rendered at its own
    time."""
    psnrs = []
    ssims = []
    distances = []
    for image in images:
        rendered = drawing.image(image.cameras, image.time)
        truth = image.composite(drawing.background)
        if not bool(rendered.isfinite().all()):
            raise DyngsError(f"view {image.name!r}: the render holds NaN or Inf")
        psnrs.append(psnr(rendered, truth, image.mask))
        ssims.append(ssim(rendered, truth, image.mask))
        distances.append(lpips(rendered, truth, image.mask).value)
    known = [x for x in distances if x is not None]
    return fmean(psnrs), fmean(ssims), fmean(known) if len(known) == len(distances) else None
