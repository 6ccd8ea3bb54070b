"""What a file of Gaussians holds, whatever its format, and which values of it can be drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from dyngs.conventions import RasterizeMode, num_sh_terms
from dyngs.errors import DyngsError
from dyngs.files.limits import require_at_most
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions

Nonfinite = Literal["error", "skip"]

MOST_LOGIT = 16.0
"""Infinite logits become this: an opacity of 1 - 1e-7. Files with opacities in 8 bits hold exactly 0 and 1."""
LEAST_LOG_SCALE = -30.0
"""Scales of 0, flat Gaussians, become exp(-30) = 1e-13."""
MOST_LOG_SCALE = 80.0
"""Beyond 88 the scale itself is infinite in float32."""
MOST_GAUSSIANS = 1 << 26
"""Limit on the Gaussians of a file whose size does not bound them: 16 GB in memory with harmonics of degree 3."""


@dataclass(frozen=True)
class SplatFile:
    """Contents of a file of Gaussians.

    Attributes:
        gaussians: float32 on the CPU, quaternions of unit length (zero ones become the identity).
        mode: render mode stated in the file; classic if none is.
        eps2d: 2D low-pass variance in px^2 stated in the file, or None.
        world_offset: (3,) float64, see ``turned``.
        comments: all header comments, in order.
        up: the axis that points up, such as "-y"; None: neither the file nor its format says.
        turned: (4,) wxyz, the rotation from the axes of the capture to those of the file: the inverse applied to the
            means, plus ``world_offset``, gives the coordinates of the original capture.
        notes: a line about each thing that was changed in reading.
    """

    gaussians: Gaussians
    mode: RasterizeMode = RasterizeMode.CLASSIC
    eps2d: float | None = None
    world_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    comments: tuple[str, ...] = ()
    up: str | None = None
    turned: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()


def splat_options(splat: SplatFile) -> RenderOptions:
    """Return the render options stated in a splat file: its mode, and its low-pass filter if any."""
    options = RenderOptions(mode=splat.mode)
    return options if splat.eps2d is None else replace(options, eps2d=splat.eps2d)


def drawable(splat: SplatFile, path: Path, nonfinite: Nonfinite) -> SplatFile:
    """Return the contents with values that can be drawn, and a note about each kind of change.

    Infinite logits and scales of zero are brought to finite values: they mean exactly opaque, transparent or flat.

    Args:
        splat: as read.
        path: for messages.
        nonfinite: "skip" leaves out Gaussians with NaN or other infinities, "error" refuses the file.

    Raises:
        DyngsError: no Gaussians, or none that can be drawn, or ``nonfinite`` is "error" and some cannot.
    """
    total = len(splat.gaussians)
    gaussians, notes = _clamped(splat.gaussians)
    bad_of = [~x[:, None].flatten(1).isfinite().all(1) for x in gaussians.tensors().values()]
    bad = torch.stack([*bad_of, (gaussians.log_scales > MOST_LOG_SCALE).any(1)]).any(0)
    count = int(bad.sum())
    if count and nonfinite == "error":
        raise DyngsError(f"{path}: {count:,} of {total:,} Gaussians have non-finite values (NaN or Inf)")
    if count:
        gaussians = gaussians.select(~bad)
        notes.append(f"{count:,} of {total:,} Gaussians are left out: they have non-finite values (NaN or Inf)")
    if len(gaussians) == 0:
        raise DyngsError(f"{path}: holds no Gaussians" + (" with finite values" if total else ""))
    return replace(splat, gaussians=gaussians, notes=(*splat.notes, *notes))


def _clamped(gaussians: Gaussians) -> tuple[Gaussians, list[str]]:
    """Return the Gaussians with finite logits and scales above 0, and notes about them."""
    notes: list[str] = []
    logits, scales = gaussians.logit_opacities, gaussians.log_scales
    opaque, clear = int((logits == torch.inf).sum()), int((logits == -torch.inf).sum())
    if opaque or clear:
        kinds = [f"{n:,} {word}" for n, word in ((opaque, "exactly opaque"), (clear, "exactly transparent")) if n]
        least = f"{1 - torch.sigmoid(torch.tensor(MOST_LOGIT, dtype=torch.float64, device='cpu')).item():.0e}"
        notes.append(f"{' and '.join(kinds)} Gaussians (infinite logits) are brought within {least} of that")
        logits = logits.clamp(-MOST_LOGIT, MOST_LOGIT)
        logits = torch.where(gaussians.logit_opacities.isinf(), logits, gaussians.logit_opacities)
    flat = scales == -torch.inf
    if bool(flat.any()):
        notes.append(f"{int(flat.any(1).sum()):,} Gaussians with a size of 0 along an axis get 1e-13 instead")
        scales = torch.where(flat, torch.full_like(scales, LEAST_LOG_SCALE), scales)
    return gaussians.replace(logit_opacities=logits, log_scales=scales), notes


def require_count(path: Path, count: int, available: int, each: float) -> None:
    """Check the number of Gaussians that a header states, before memory is allocated for them.

    Args:
        path: for the message.
        count: as stated.
        available: bytes that the file has for them.
        each: bytes that one Gaussian takes at least.

    Raises:
        DyngsError: the file is cut off, or asks for more than ``MOST_GAUSSIANS``.
    """
    if count * each > available:
        raise DyngsError(
            f"{path}: is truncated: {count:,} Gaussians need {count * each:,.0f} bytes, found {available:,}; copy or "
            "export it again"
        )
    require_at_most(path, count, MOST_GAUSSIANS, "Gaussians")


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the Gaussians with harmonics of ``degree``: higher ones left out, missing ones zero."""
    terms, has = num_sh_terms(degree), gaussians.sh.shape[1]
    if terms <= has:
        return gaussians.replace(sh=gaussians.sh[:, :terms].contiguous())
    return gaussians.replace(sh=torch.nn.functional.pad(gaussians.sh, (0, 0, 0, terms - has)))


def unit_rotations(quats: Tensor) -> Tensor:
    """Return quaternions (N, 4) of unit length; zero becomes the identity, NaN and Inf stay, unit ones keep their bits.

    float64, because float32 squares of 1e-30 and 1e30 leave the range.
    """
    wide = quats.double()
    norm = wide.norm(dim=1, keepdim=True)
    identity = wide.new_tensor([1.0, 0.0, 0.0, 0.0])
    unit = torch.where((norm - 1).abs() < 1e-6, wide, wide / norm)
    return torch.where(norm == 0, identity, unit).float()
