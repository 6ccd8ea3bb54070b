"""Former names of keys and kinds: runs of before are read, presets and overrides are told the present name."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.config import Config, DefaultStrategy
from dyngs.config.io import load_config, load_resolved, packaged_preset, save_config
from dyngs.config.renamed import CONSTANTS, KEYS, KINDS
from dyngs.config.schema import config_keys
from dyngs.errors import DyngsError

FORMER = Path(__file__).parent / "former"
"""Resolved configurations as the version before the new names wrote them."""
PRESETS = ("static", "blender", "colmap", "dynamic", "human_net", "mip", "static_mcmc")
MORE = {
    "dynamic_hexplane": (
        "model.deform.kind=hexplane",
        "colour.kind=network",
        "prune.fraction=0.7",
        "prune.mask_times=6",
        "prune.mask_below=0.5",
        "budget.max_mb=5",
    ),
    "dynamic_mlp": ("model.deform.kind=mlp", "colour.kind=auto"),
    "dynamic_trajectory": ("model.deform.kind=trajectory", "strategy.kind=mcmc"),
}
PRESENT = {"human_net": "human_predictor"}


def now(preset: str, *overrides: str) -> Config:
    config = load_config(packaged_preset(PRESENT.get(preset, preset)), ["data.root=/captures/one", *overrides])
    name = config.run.name if preset not in PRESENT else preset
    return config.model_copy(update={"run": config.run.model_copy(update={"name": name})})


ADDED = {
    "dynamic": ("model.compare_with_still=false", "model.pilot_steps=0", "train.alpha_weight=0"),
}
"""Overrides that undo what presets ask for since."""


def with_choices(config: Config) -> Config:
    """``config``, in which numbers that stood for never are what a preset now says instead."""
    strategy = config.strategy
    if isinstance(strategy, DefaultStrategy):
        if strategy.max_gaussians == 1:
            strategy = strategy.model_copy(update={"grow": False, "max_gaussians": DefaultStrategy().max_gaussians})
        if strategy.reset_every == 1_000_000:
            strategy = strategy.model_copy(update={"reset_every": None})
    return config.model_copy(update={"strategy": strategy})


@pytest.mark.parametrize("preset", PRESETS)
def test_runs_of_before_are_what_their_presets_still_say(preset: str, tmp_path: Path) -> None:
    """But for what the preset of moving scenes asks for since: silhouettes where needed, a static model beside it."""
    config, asked = load_resolved(FORMER / f"{preset}.yaml"), ADDED.get(preset, ())
    assert with_choices(config) == now(preset, *asked)
    save_config(config, tmp_path / "config.yaml")
    assert load_resolved(tmp_path) == config


@pytest.mark.parametrize("name", MORE)
def test_former_kinds_are_read(name: str) -> None:
    assert with_choices(load_resolved(FORMER / f"{name}.yaml")) == now("dynamic", *ADDED["dynamic"], *MORE[name])


def test_every_present_name_exists_and_no_former_one() -> None:
    names = {key.name for key in config_keys()}
    sections = {name.rsplit(".", n)[0] for name in names for n in (1, 2) if name.count(".") >= n}
    assert set(KEYS.values()) <= names | sections
    assert not set(KEYS) & (names | sections)
    for key, kinds in KINDS.items():
        allowed = next(row for row in config_keys() if row.name == key).allowed.removeprefix("one of ").split(", ")
        assert set(kinds.values()) <= set(allowed)
        assert not set(kinds) & set(allowed)


@pytest.mark.parametrize("key", CONSTANTS)
def test_keys_that_are_constants_are_gone(key: str) -> None:
    allowed = {kind for row in config_keys() if row.name == key for kind in row.kinds or ("",)}
    assert not allowed & set(CONSTANTS[key])
    with pytest.raises(DyngsError) as caught:
        load_config(None, ["data.root=x", f"{key}=1"])
    assert str(caught.value) == f"{key}=1: {key} can no longer be chosen; leave it out"


@pytest.mark.parametrize(
    ("name", "line", "key", "value"),
    [
        ("dynamic", "lr_decay: 0.2", "model.deform.lr_decay", "0.01"),
        ("static", "eps: 1.0e-15", "optim.eps", "1.0e-8"),
        ("static", "eps: 1.0e-15", "optim.eps", "true"),
    ],
)
def test_a_run_with_another_value_of_a_constant_is_refused(
    name: str, line: str, key: str, value: str, tmp_path: Path
) -> None:
    text = (FORMER / f"{name}.yaml").read_text()
    assert text.count(line) == 1
    (tmp_path / "config.yaml").write_text(text.replace(line, f"{line.split(':')[0]}: {value}"))
    with pytest.raises(DyngsError) as caught:
        load_resolved(tmp_path)
    assert f": {key} can no longer be chosen, it is always " in str(caught.value)
    assert f"not {value}; train anew" in str(caught.value)


@pytest.mark.parametrize("former", KEYS)
def test_an_override_with_a_former_key_is_told_the_new_one(former: str) -> None:
    with pytest.raises(DyngsError) as caught:
        load_config(None, ["data.root=x", f"{former}=1"])
    assert str(caught.value) == f"{former}=1: {former} is called {KEYS[former]} now; write that"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("model:\n  kind: dynamic\n  seeds: 5\n", (":3: model.seeds is called model.num_random_moving now",)),
        (
            "compact:\n  max_loss: 5\n",
            (":2: compact.max_loss can no longer be chosen; the stage removes just prune.fraction",),
        ),
        ("colour:\n  kind: dcac\n", (":2: colour.kind=dcac is called network now",)),
        ("compact:\n", (":1: compact is called prune now",)),
    ],
)
def test_a_preset_with_a_former_name_is_told_the_new_one(text: str, parts: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(DyngsError) as caught:
        load_config(tmp_path / "mine.yaml", ["data.root=x"])
    for part in (str(tmp_path / "mine.yaml"), *parts):
        assert part in str(caught.value)


def test_former_kinds_and_presets_are_told_the_new_names() -> None:
    for override in ("model.deform.kind=skeleton", "model.kind=human_net"):
        with pytest.raises(DyngsError, match=r"is called (control_nodes|human_predictor) now"):
            load_config(packaged_preset("dynamic"), ["data.root=x", override])
    with pytest.raises(DyngsError, match="this preset is called human_predictor now"):
        load_config(Path("configs/human_net.yaml"), ["data.root=x"])


def test_a_resolved_file_holds_a_key_once(tmp_path: Path) -> None:
    text = "data: {root: x}\nmodel: {kind: dynamic, coarse: 0.2, motion_from: 0.3}\n"
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(DyngsError, match=r"config.yaml:2: model.motion_from is given twice, .*keep one"):
        load_resolved(tmp_path)
    (tmp_path / "config.yaml").write_text(text.replace(", motion_from: 0.3", ""))
    assert load_resolved(tmp_path, ["model.motion_from=0.4"]).model.model_dump()["motion_from"] == 0.4
    with pytest.raises(DyngsError, match=r"model.coarse is called model.motion_from now"):
        load_resolved(tmp_path, ["model.coarse=0.4"])
