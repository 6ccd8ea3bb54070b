"""What callers may set: ranges and choices, refused in one line that names the option."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from dyngs.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions
from dyngs.ops.options import check_choice, check_count, check_near_and_far, check_number
from dyngs.ops.projection import ProjectionOptions
from dyngs.ops.rasterization import BlendOptions

WRONG: dict[str, list[Any]] = {
    "eps2d": [-0.1, math.nan, math.inf, "0.3", None],
    "near": [-0.1, math.nan, math.inf, None],
    "far": [-1.0, 0.1, 0.2, math.nan, None],
    "alpha_min": [-0.1, 1.1, math.nan, None],
    "alpha_max": [-0.1, 1.0, 1 - 1e-9, math.nan],
    "transmittance_min": [-0.1, 1.1, math.nan],
    "radius_clip": [-0.1, math.nan, math.inf],
    "max_entries": [-1, math.nan],
    "sh_degree": [-1, 5, 1.5, True],
    "mode": ["mip", None, 3],
    "depth": ["metric", None],
    "nonfinite": ["ignore", None],
}
CASES = [
    (kind, name, value)
    for kind in (ProjectionOptions, BlendOptions, RenderOptions)
    for name, values in WRONG.items()
    for value in values
    if name in kind.__dataclass_fields__ and not (name == "sh_degree" and value is None)
]


@pytest.mark.parametrize(("kind", "name", "value"), CASES)
def test_options_out_of_range_are_refused_by_name(kind: type, name: str, value: Any) -> None:
    """NaN gave an empty image, an unknown word the last of the choices."""
    with pytest.raises(DyngsError, match=f"^{name} must "):
        kind(**{name: value})


@pytest.mark.parametrize(
    "options",
    [
        {"near": 0, "far": math.inf, "eps2d": 0, "alpha_min": 0, "transmittance_min": 0},
        {"alpha_max": 0.999, "sh_degree": 0, "mode": "antialiased", "depth": "expected", "nonfinite": "skip"},
    ],
)
def test_the_ends_of_the_ranges_are_allowed(options: dict[str, Any]) -> None:
    assert RenderOptions(**options).projection.near >= 0


def test_largest_alpha_leaves_something_in_float32() -> None:
    from dyngs.ops.rasterization import LARGEST_ALPHA

    assert 1 - torch.tensor(BlendOptions(alpha_max=LARGEST_ALPHA).alpha_max) > 0


def test_messages_say_what_is_wanted_and_what_was_given() -> None:
    for check, message in (
        (lambda: check_number("size", math.nan, 0), "size must be a number of at least 0 and finite, got nan"),
        (lambda: check_number("share", 2, 0, 1), "share must be a number of at least 0 and at most 1, got 2"),
        (lambda: check_count("degree", 7, 0, 4), "degree must be a whole number from 0 to 4, got 7"),
        (lambda: check_choice("mode", "x", ("a", "b")), "mode must be one of a, b, got 'x'"),
        (lambda: check_near_and_far(2, 1), "far must lie beyond near, got near 2 and far 1"),
    ):
        with pytest.raises(DyngsError) as caught:
            check()
        assert str(caught.value) == message
