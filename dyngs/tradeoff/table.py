"""The table of a sweep: one row per measured variant, with what the report, the plot and the requirements use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from dyngs.tradeoff.measurements import Measurement
from dyngs.tradeoff.pareto import on_front
from dyngs.tradeoff.variants import Variant

METRICS = ("psnr", "ssim", "lpips", "fps", "mb", "memory_mb", "gaussians")
"""Columns that a requirement or a goal may name."""


@dataclass(frozen=True)
class TableRow:
    """A measured variant. The fields but ``variant``, after its name, are the columns of the .csv.

    Attributes:
        variant: settings that differ from the run.
        psnr, ssim, lpips: means over the split; LPIPS is None where it cannot be computed.
        fps: frames per second of the run itself times ``gain``, so that variants timed at another hour compare.
        gain, gain_low, gain_high: speed relative to the run: median and quartiles of interleaved pairs.
        ms: median time of one image as measured.
        mb, memory_mb, gaussians: see ``Measurement``.
        on_front: on the Pareto front of PSNR, speed and size.
    """

    variant: Variant
    psnr: float
    ssim: float
    lpips: float | None
    fps: float
    gain: float
    gain_low: float
    gain_high: float
    ms: float
    mb: float
    memory_mb: float | None
    gaussians: int
    on_front: bool

    @property
    def name(self) -> str:
        """Name of the variant."""
        return self.variant.name

    @property
    def columns(self) -> dict[str, str | float | None]:
        """Names and values of the columns."""
        return {"name": self.name} | {f.name: getattr(self, f.name) for f in fields(self) if f.name != "variant"}

    def metric(self, name: str) -> float | None:
        """Return the value of one of ``METRICS``; None where it was not measured."""
        return getattr(self, name)


def table_rows(measurements: Sequence[Measurement]) -> list[TableRow]:
    """Return a row per variant whose speed was measured, in their order.

    Args:
        measurements: the run itself first.
    """
    base = measurements[0].speed
    fps = 0.0 if base is None else 1e3 / base.ms.median
    return [
        TableRow(
            variant=m.variant,
            psnr=m.psnr,
            ssim=m.ssim,
            lpips=m.lpips,
            fps=fps * m.speed.gain.median,
            gain=m.speed.gain.median,
            gain_low=m.speed.gain.low,
            gain_high=m.speed.gain.high,
            ms=m.speed.ms.median,
            mb=m.mb,
            memory_mb=m.memory_mb,
            gaussians=m.num_gaussians,
            on_front=is_best,
        )
        for m, is_best in zip(measurements, on_front(measurements), strict=True)
        if m.speed is not None
    ]
