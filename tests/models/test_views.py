"""The background to evaluate on."""

from __future__ import annotations

import pytest

from dyngs.models.views import evaluation_background


@pytest.mark.parametrize(
    ("choice", "has_alpha", "name"),
    [
        ("auto", True, "white"),
        ("auto", False, "black"),
        ("random", True, "black"),
        ("random", False, "black"),
        ("white", False, "white"),
        ("black", True, "black"),
    ],
)
def test_it_is_that_of_training(choice: str, has_alpha: bool, name: str) -> None:
    """Black where that was random; only "auto" looks at alpha."""
    resolved, rgb = evaluation_background(choice, has_alpha)
    assert resolved == name
    assert rgb.tolist() == [1.0 if name == "white" else 0.0] * 3
