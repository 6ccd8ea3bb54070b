"""Descriptions of the configuration keys."""

from __future__ import annotations

from dyngs.config.schema import config_keys


def test_known_rows() -> None:
    rows = {(key.name, *key.kinds): key for key in config_keys()}
    assert all(key.description for key in rows.values())
    expected = {
        ("data.root",): ("a path", ""),
        ("train.steps",): ("an integer >= 1", "7000"),
        ("strategy.kind",): ("one of default, mcmc, fixed", "default"),
        ("train.ssim_weight",): ("a number >= 0 and <= 1", "0.2"),
        ("data.longest_side",): ("an integer >= 0 or null", "1600"),
        ("strategy.max_gaussians", "mcmc"): ("an integer >= 1", "300000"),
        ("model.deform.kind", "dynamic"): (
            "one of hexplane, mlp, control_nodes, free, gaussians_4d",
            "hexplane",
        ),
    }
    for key, found in expected.items():
        assert (rows[key].allowed, rows[key].default) == found, key


def test_optional_numbers_with_bounds_are_described_in_words() -> None:
    kinds = {key.allowed for key in config_keys() if key.name == "model.deform.lr_means"}
    assert "a number > 0 or null" in kinds
    assert not any("Annotated" in key.allowed for key in config_keys())
