"""Gaussians in the optimised parametrisation, topology edits, and Morton order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.errors import format_count
from dyngs.core.tensor_checks import require_tensor

LARGEST_LOG_SCALE = 88  # Natural logarithm of the largest size that float32 can hold, rounded down


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in the parametrisation that is optimised.

    Example:

        import torch

        import dyngs

        one = dyngs.Gaussians(
            means=torch.tensor([[0.0, 0, 4]]),
            quats=torch.tensor([[1.0, 0, 0, 0]]),
            log_scales=torch.full((1, 3), -1.0),
            logit_opacities=torch.tensor([3.0]),
            sh=torch.ones(1, 1, 3),
        )

    Attributes:
        means: (N, 3) centres in world units.
        quats: (N, 4) rotations wxyz; normalised by the rasterizer, a zero quaternion means
            identity.
        log_scales: (N, 3) natural logarithms of the standard deviations along the local axes.
        logit_opacities: (N,) opacities before the sigmoid.
        sh: (N, K, 3) spherical-harmonics coefficients, term 0 is the base colour.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = len(self.means)
        wanted = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise ValueError(f"{name} must be {shape}, got {tuple(getattr(self, name).shape)}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[2] != 3:
            raise ValueError(f"sh must be ({n}, K, 3), got {tuple(self.sh.shape)}")

    @staticmethod
    def stored(tensors: Mapping[str, Tensor]) -> Gaussians:
        """Restore Gaussians from the tensors of a file, by field name.

        Raises:
            KeyError: a tensor is missing.
            ValueError: values that are not finite float32, invalid scales, mismatching shapes, or
                an invalid number of SH coefficients.
        """
        found = Gaussians(**{f.name: tensors[f.name] for f in fields(Gaussians)})
        for name, x in found.tensors().items():
            require_tensor(name, x, x.shape)
        if bool((found.log_scales > LARGEST_LOG_SCALE).any()):
            raise ValueError(
                f"'log_scales' has values above {LARGEST_LOG_SCALE}, which overflow float32"
            )
        if found.sh.shape[1] not in [num_sh_terms(degree) for degree in range(MAX_SH_DEGREE + 1)]:
            raise ValueError(f"'sh' has an invalid number of coefficients ({found.sh.shape[1]})")
        return found

    @staticmethod
    def isotropic(
        means: Tensor, log_scales: Tensor | float, logit: float, base: Tensor, num_terms: int
    ) -> Gaussians:
        """Create isotropic Gaussians at ``means`` (N, 3) with the given log scale(s) and opacity.

        ``base`` (N, 3): SH coefficients of degree 0; the others of the ``num_terms`` are zero.
        """
        count = len(means)
        sh = means.new_zeros(count, num_terms, 3)
        sh[:, 0] = base
        quats = means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
        logits = means.new_full((count,), logit)
        return Gaussians(means, quats, means.new_zeros(count, 3) + log_scales, logits, sh)

    @staticmethod
    def joined(parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate sets of Gaussians of the same SH degree."""
        tensors = [part.tensors() for part in parts]
        return Gaussians(**{name: torch.cat([x[name] for x in tensors]) for name in tensors[0]})

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        count = format_count(len(self), "Gaussian")
        return f"Gaussians({count}, SH degree {self.sh_degree}, {self.means.device})"

    @property
    def scales(self) -> Tensor:
        """Return (N, 3) standard deviations in world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Return (N,) opacities in [0, 1]."""
        return self.logit_opacities.sigmoid()

    @property
    def base_rgb(self) -> Tensor:
        """Return (N, 3) view-independent colours, not clamped to [0, 1]."""
        return self.sh[:, 0] * SH_C0 + 0.5

    @property
    def sh_degree(self) -> int:
        """Degree of the harmonics."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by field name, in the order of declaration."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def select(self, index: Tensor | slice) -> Gaussians:
        """Return the Gaussians at ``index`` ((M,) long, (N,) bool or a slice)."""
        return Gaussians(**{name: x[index] for name, x in self.tensors().items()})

    def picked(self, rows: Tensor) -> Gaussians:
        """Return the Gaussians at ``rows`` (long), with a faster backward pass than ``select``."""
        return Gaussians(**{name: x.index_select(0, rows) for name, x in self.tensors().items()})

    def apply_edit(self, edit: TopologyEdit) -> Gaussians:
        """Return the Gaussians after ``edit``, without gradients."""
        return self.detach().select(edit.source)

    def to(
        self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Gaussians:
        """Return the Gaussians on another device or in another precision; copy only if needed."""
        return Gaussians(
            **{name: x.to(device=device, dtype=dtype) for name, x in self.tensors().items()}
        )

    def detach(self) -> Gaussians:
        """Return the same Gaussians without gradients."""
        return Gaussians(**{name: x.detach() for name, x in self.tensors().items()})

    def replace(self, **changes: Tensor) -> Gaussians:
        """Return a copy with some fields replaced."""
        return replace(self, **changes)


@dataclass(frozen=True)
class TopologyEdit:
    """Mapping of old to new rows by densification or pruning, applied to all per-Gaussian tensors.

    Row ``i`` of the new set comes from row ``source[i]`` of the old set: clone, split, prune and
    relocate are all ``x[source]``. Rows with ``is_new`` start with zero optimizer moments.
    """

    source: Tensor  # (N_new,) long indices into the old set
    is_new: Tensor  # (N_new,) bool

    def apply(self, x: Tensor) -> Tensor:
        """Return the rows of ``x`` (N_old, ...) rearranged to (N_new, ...)."""
        return x[self.source]

    def apply_moments(self, x: Tensor) -> Tensor:
        """Return ``apply(x)`` with zeros where a row is new."""
        moved = x[self.source]
        moved[self.is_new] = 0
        return moved

    def in_order(self, order: Tensor) -> TopologyEdit:
        """Return the same edit with the rows of the new set in ``order`` (N_new,)."""
        return TopologyEdit(self.source[order], self.is_new[order])

    @staticmethod
    def select(index: Tensor) -> TopologyEdit:
        """Return the edit that keeps the rows at ``index`` (long or bool)."""
        source = torch.nonzero(index)[:, 0] if index.dtype == torch.bool else index
        return TopologyEdit(source, torch.zeros_like(source, dtype=torch.bool))


MORTON_BITS = 20  # Bits per coordinate; 60 in all
INNER, OUTLYING = 0.01, 64.0
"""Outliers are clamped: points beyond ``OUTLYING`` sides of the box of the inner quantiles."""
SPREADING = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that insert two zero bits between the bits of a 21-bit number."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return (N,) indices that sort ``points`` (N, 3) in Morton order; ties by index."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    places = points.astype(np.float64)
    inner_low, inner_high = np.quantile(places, (INNER, 1 - INNER), axis=0, method="nearest")
    reach = OUTLYING * float((inner_high - inner_low).max())
    if reach > 0:
        places = places.clip(inner_low - reach, inner_high + reach)
    low = places.min(0)
    side = max(float((places.max(0) - low).max()), np.finfo(np.float64).tiny)
    bits = ((places - low) / side * (2**MORTON_BITS - 1)).astype(np.uint64)
    for shift, mask in SPREADING:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    code = bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2)
    return np.argsort(code, kind="stable")


def storage_order(means: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return (N,) indices that sort ``means`` (N, 3): moving ``rows`` (M,) first, then the static
    ones, both in Morton order."""
    is_static = np.ones(len(means), dtype=bool)
    is_static[rows] = False
    static = np.flatnonzero(is_static)
    return np.concatenate(
        [rows[morton_order(means[rows])], static[morton_order(means[static])]]
    ).astype(np.int64)
