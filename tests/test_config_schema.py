"""The keys in words: complete, and the same in the documentation."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import Config
from dyngs.config_schema import config_keys, keys_table, section_class

DOCS = Path(__file__).resolve().parents[1] / "docs" / "cli.md"


def test_every_key_of_every_section_is_there() -> None:
    names = {(key.name, key.kind) for key in config_keys()}
    assert {name.split(".")[0] for name, _ in names} == set(Config.model_fields)
    assert ("strategy.max_gaussians", "default") in names
    assert ("strategy.max_gaussians", "mcmc") in names
    assert ("train.steps", "") in names
    for key in Config.model_fields["strategy"].get_default().model_dump():
        assert any(name == f"strategy.{key}" for name, _ in names)


def test_known_rows() -> None:
    rows = {(key.name, key.kind): key for key in config_keys()}
    assert rows["data.root", ""].default == ""
    assert rows["data.root", ""].allowed == "a path"
    assert rows["strategy.kind", ""].allowed == "one of default, mcmc"
    assert rows["train.ssim_weight", ""].allowed == "a number >= 0 and <= 1"
    assert rows["data.longest_side", ""].allowed == "an integer >= 1 or null"
    assert rows["train.tensorboard", ""].allowed == "true or false"


def test_a_section_is_found_by_its_kind() -> None:
    assert section_class("strategy", "mcmc").__name__ == "McmcStrategy"
    assert section_class("init", "points") is section_class("init", "auto") is section_class("init")


def test_the_documentation_has_the_table() -> None:
    """If this fails, print the table anew as docs/cli.md says."""
    assert DOCS.read_text(encoding="utf-8").endswith(keys_table())
