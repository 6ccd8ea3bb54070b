"""The keys in words: complete, and the same in the documentation."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from pydantic.fields import FieldInfo

from dyngs.config import (
    Config,
    DefaultStrategy,
    DynamicModel,
    HexplaneField,
    McmcStrategy,
    MlpField,
    StaticModel,
    TrainConfig,
)
from dyngs.config.schema import (
    allowed_values,
    config_keys,
    keys_of_location,
    keys_table,
    kinds_of,
    section_at,
    section_class,
)

DOCS = Path(__file__).resolve().parents[2] / "docs" / "cli.md"


def test_every_key_of_every_section_is_there() -> None:
    names = {(key.name, key.kinds) for key in config_keys()}
    assert {name.split(".")[0] for name, _ in names} == set(Config.model_fields)
    assert ("strategy.max_gaussians", ("default",)) in names
    assert ("strategy.max_gaussians", ("mcmc",)) in names
    assert ("train.steps", ()) in names
    for key in Config.model_fields["strategy"].get_default().model_dump():
        assert any(name == f"strategy.{key}" for name, _ in names)


def test_every_key_is_described() -> None:
    assert [key.name for key in config_keys() if not key.description] == []
    kind = next(key for key in config_keys() if key.name == "strategy.kind")
    assert "default: clone, split" in kind.description
    assert "mcmc: a fixed cap" in kind.description


def test_nested_keys_name_the_kinds_that_have_them() -> None:
    names = [(key.name, key.kinds) for key in config_keys()]
    assert len(set(names)) == len(names)
    assert ("data.root", ()) in names
    assert (
        "model.sh_degree",
        ("static or dynamic or human or human_predictor or gps",),
    ) in names, "fields have none"
    assert ("model.motion_from", ("dynamic",)) in names
    assert ("model.deform.kind", ("dynamic",)) in names
    assert ("model.deform.moves", ("dynamic", "hexplane or mlp or control_nodes")) in names, (
        "those have it alike"
    )
    assert ("model.deform.width", ("dynamic", "hexplane")) in names
    assert ("model.deform.width", ("dynamic", "mlp")) in names
    written = [line.split("|")[1].strip() for line in keys_table().splitlines()]
    assert "`model.deform.width` (dynamic, mlp)" in written
    for field in (HexplaneField(), MlpField()):
        known = {
            name
            for name, kinds in names
            if kinds[:1] == ("dynamic",) and field.kind in kinds[-1].split(" or ")
        }
        known |= {name for name, kinds in names if kinds == ("dynamic",)}
        assert known >= {f"model.deform.{key}" for key in field.model_dump()}


def test_known_rows() -> None:
    rows = {(key.name, *key.kinds): key for key in config_keys()}
    assert rows["data.root",].default == ""
    assert rows["data.root",].allowed == "a path"
    assert rows["strategy.kind",].allowed == "one of default, mcmc, fixed"
    assert rows["train.ssim_weight",].allowed == "a number >= 0 and <= 1"
    assert rows["data.longest_side",].allowed == "an integer >= 1 or null"
    assert rows["train.tensorboard",].allowed == "true or false"
    levels = rows["model.deform.levels", "dynamic", "hexplane"]
    assert (levels.allowed, levels.default) == ("a non-empty list of integers >= 1", "[1, 2]")


def test_lists_in_words() -> None:
    def words(annotation: Any) -> str:
        return allowed_values(FieldInfo.from_annotation(annotation))

    assert words(tuple[int, ...]) == "a list of integers"
    assert (
        words(tuple[Annotated[float, Field(gt=0, le=2)], ...]) == "a list of numbers > 0 and <= 2"
    )
    assert words(tuple[str, ...] | None) == "a list of texts or null"


def test_cells_of_the_table_hold_together() -> None:
    """A bar in a description would end its cell."""
    for line in keys_table().splitlines():
        assert len(re.findall(r"(?<!\\)\|", line)) == 5, line


def test_a_section_is_found_by_its_kind() -> None:
    strategy = Config.model_fields["strategy"]
    init = Config.model_fields["init"]
    assert section_class(strategy, "mcmc") is McmcStrategy
    assert section_class(strategy, "none such") is DefaultStrategy
    assert section_class(init, "points") is section_class(init, "auto") is section_class(init, None)
    assert kinds_of(init) == ["auto", "points", "random", "scene"]
    assert kinds_of(Config.model_fields["train"]) == []


def test_a_section_is_found_in_a_tree() -> None:
    tree = {"model": {"kind": "dynamic", "deform": {"kind": "mlp"}}, "train": 5}
    assert section_at(tree, ("model",)) is Config
    assert section_at(tree, ("model", "deform")) is DynamicModel
    assert section_at(tree, ("model", "deform", "width")) is MlpField
    assert section_at({"model": {"kind": "dynamic"}}, ("model", "deform", "width")) is HexplaneField
    assert section_at({}, ("model", "deform", "width")) is StaticModel
    assert section_at(tree, ("train", "steps")) is TrainConfig
    assert section_at(tree, ("nothing", "at", "all")) is Config


def test_locations_of_pydantic_lose_kinds_and_indices() -> None:
    assert keys_of_location(("model", "dynamic", "deform", "mlp", "width")) == (
        "model",
        "deform",
        "width",
    )
    assert keys_of_location(("model", "dynamic", "deform", "hexplane", "levels", 1)) == (
        "model",
        "deform",
        "levels",
    )
    assert keys_of_location(("model", "dynamic", "dynamic")) == ("model", "dynamic")
    assert keys_of_location(("model", "dynamic", "deform")) == ("model", "deform")
    assert keys_of_location(("train", "steps")) == ("train", "steps")
    assert keys_of_location(("trian",)) == ("trian",)


def test_the_documentation_has_the_table() -> None:
    """If this fails, print the table anew as docs/cli.md says."""
    assert DOCS.read_text(encoding="utf-8").endswith(keys_table())
