"""Configuration files: presets, overrides, error messages and saving."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    OptimConfig,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import (
    REMOVED_MODEL_KEYS,
    RESOLVED_NAME,
    find_preset,
    load_config,
    load_resolved,
    packaged_preset,
    save_config,
)
from dyngs.config.yaml_reader import MAX_BYTES
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.deform.keys import ControlNodesField, DynamicModel, HexplaneField, MlpField
from dyngs.models.static_section import StaticModel

PRESETS = ("static", "blender", "colmap", "static_mcmc", "mip", "4dgs", "deformable_3dgs")
ROOT = "data.root=capture"


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(preset: Path | None, *overrides: str) -> str:
    """The one line that a bad configuration is answered with."""
    with pytest.raises(DyngsError) as caught:
        load_config(preset, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


# ----------------------------------------------------------------------------------------- presets


@pytest.mark.parametrize("name", PRESETS)
def test_packaged_presets_load_from_an_empty_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load_config(Path(f"configs/{name}.yaml"), [ROOT])
    assert config.run.name == name
    assert config.data.root == tmp_path / "capture"
    assert load_config(Path(name), [ROOT]) == config


def test_published_protocols() -> None:
    blender = load_config(packaged_preset("blender"), [ROOT])
    assert blender.train.steps == 30_000
    assert blender.data.background == "white"
    assert blender.init == RandomInit(num_random=100_000)
    assert (blender.strategy, blender.optim) == (DefaultStrategy(), OptimConfig())
    colmap = load_config(packaged_preset("colmap"), [ROOT])
    assert (colmap.train.steps, colmap.data.test_every, colmap.data.longest_side) == (
        30_000,
        8,
        1600,
    )
    mip = load_config(packaged_preset("mip"), [ROOT]).model
    assert (mip.rasterize_mode, mip.eps2d, mip.filter_3d) == (RasterizeMode.ANTIALIASED, 0.1, True)
    assert isinstance(load_config(packaged_preset("static_mcmc"), [ROOT]).strategy, McmcStrategy)


def test_a_mistyped_path_is_not_taken_for_a_packaged_preset(tmp_path: Path) -> None:
    message = refusal(tmp_path / "static.yaml")
    assert "no such preset" in message
    assert "static_mcmc" in message
    with pytest.raises(DyngsError, match="did you mean 'blender'"):
        find_preset(Path("blendr"))


@pytest.mark.parametrize(
    ("former", "value", "current"),
    [("model.choose", "true", "model.pilot_runs"), ("init.trains", "colour", "init.trainable")],
)
def test_renamed_keys_are_refused_with_their_new_names(
    former: str, value: str, current: str, tmp_path: Path
) -> None:
    assert refusal(None, ROOT, f"{former}={value}").endswith(f"{former} was renamed; use {current}")
    section, key = former.split(".")
    preset = write(tmp_path, f"{section}:\n  {key}: {value}\n")
    assert f"mine.yaml:2: {former} was renamed" in refusal(preset, ROOT)


def test_stored_configurations_with_former_keys_and_values_still_load(tmp_path: Path) -> None:
    path = tmp_path / RESOLVED_NAME
    path.write_text(
        "data: {root: capture}\nmodel: {kind: dynamic, choose: true}\n"
        "init: {kind: scene, scene: old.ply, trains: colour}\ntrain: {robust: auto}\n"
    )
    config = load_resolved(path)
    assert config.model.pilot_runs
    assert config.train.robust == "never"
    assert config.init.trainable == "colour"
    assert (config.data.longest_side, config.data.test_first) == (None, 0), "as they were trained"


# --------------------------------------------------------------------------------------- overrides


def test_overrides_are_laid_over_the_preset(tmp_path: Path) -> None:
    preset = write(tmp_path, "data: {root: a}\ntrain:\n  steps: 10\n  ssim_weight: 0.5\n")
    config = load_config(
        preset,
        ["train.steps=20", "data.longest_side=null", "optim.lr_means=1e-4", "train.steps=30"],
    )
    assert (config.train.steps, config.train.ssim_weight, config.optim.lr_means) == (30, 0.5, 1e-4)


@pytest.mark.parametrize(
    "overrides",
    [
        ("strategy.kind=mcmc", "strategy.max_gaussians=9"),
        ("strategy.max_gaussians=9", "strategy.kind=mcmc"),
    ],
)
def test_another_kind_replaces_its_section_in_any_order(
    overrides: tuple[str, ...], tmp_path: Path
) -> None:
    preset = write(tmp_path, "strategy: {absgrad: true, max_gaussians: 5}\n")
    assert load_config(preset, [ROOT, *overrides]).strategy == McmcStrategy(max_gaussians=9)


def test_a_section_can_be_given_as_a_whole() -> None:
    config = load_config(
        None, [ROOT, "strategy={max_gaussians: 4, kind: mcmc}", "init={kind: random}"]
    )
    assert config.strategy == McmcStrategy(max_gaussians=4)
    assert isinstance(config.init, RandomInit)


def test_an_inner_kind_replaces_nothing_outside_it(tmp_path: Path) -> None:
    preset = write(
        tmp_path, "model:\n  kind: dynamic\n  sh_degree: 1\n  deform: {channels: 8, width: 32}\n"
    )
    assert load_config(preset, [ROOT, "model.deform.kind=mlp"]).model == DynamicModel(
        sh_degree=1, deform=MlpField()
    )
    same = load_config(
        preset,
        [ROOT, "model.deform.kind=hexplane", "model.kind=dynamic", "model.deform.levels=[4, 2]"],
    )
    expected = DynamicModel(sh_degree=1, deform=HexplaneField(channels=8, width=32, levels=(4, 2)))
    assert same.model == expected
    assert load_config(preset, [ROOT, "model.kind=static", "model.eps2d=0.1"]).model == StaticModel(
        eps2d=0.1
    )


@pytest.mark.parametrize(
    "text", ["2024-01-01", "007", "yes", "1e3", "null-ish", "[x", "C:\\scans", "a b"]
)
def test_names_and_paths_are_taken_as_written(text: str) -> None:
    config = load_config(None, [f"data.root={text}", f"run.name={text}"])
    assert config.run.name == text
    assert config.data.root.name == text


# ---------------------------------------------------------------------------------------- refusals

DYNAMIC = "model.kind=dynamic"


@pytest.mark.parametrize(
    ("overrides", "part"),
    [
        ("train.stesp=5", "unknown key 'train.stesp'; did you mean 'train.steps'"),
        ("trian.steps=5", "unknown key 'trian'; did you mean 'train.steps'"),
        ("steps=5", "did you mean 'train.steps'"),
        ("train.seed=5", "did you mean 'run.seed'"),
        ("train.steps=0", "train.steps must be an integer >= 1, not 0"),
        ("train.steps=0x_", "an integer >= 1, not 0x_"),
        ("train.steps=1:30", "an integer >= 1, not 1:30"),
        ("train.steps=9" + "9" * 30, "train.steps must be below 2^63"),
        ("train.steps=" + "[" * 5000, "an integer >= 1, not [[["),
        ("train.steps={a: 1, a: 2}", "duplicate key train.steps.a"),
        ("model.near=-1", "model.near must be a number > 0 and <= 1e+09 or auto, not -1"),
        ("optim.lr_means=.nan", "optim.lr_means must be a number > 0"),
        ("optim.lr_means=1e400", "optim.lr_means must be a number > 0"),
        ("data.background=whit", "one of auto, white, black, random, not whit; did you mean"),
        ("strategy.kind=mcm", "strategy.kind must be one of default, mcmc, fixed, not mcm; did"),
        ("model.kind=statc", "did you mean 'static'"),
        ("strategy.noise=1", "strategy.noise belongs to strategy.kind=mcmc, not to default"),
        ("model.deform.width=64", "model.deform belongs to model.kind=dynamic, not to static"),
        ("deform.width=64", "unknown key 'deform'"),
        ("train=5", "train is a section, not a value"),
        ("train.steps.x=5", "train.steps"),
        ("train.steps", "section.key=value"),
        (
            f"{DYNAMIC} model.deform.kind=mpl",
            "model.deform.kind must be one of hexplane, mlp, cont",
        ),
        ("model.kind=nerf model.coarse=3", "unknown key 'model.coarse'"),
        (f"{DYNAMIC} model.defrom.kind=mlp", "did you mean 'model.deform.kind'"),
        (f"{DYNAMIC} model.deform.nodes=5", "belongs to model.deform.kind=control_nodes, not to"),
        (f"{DYNAMIC} model.deform.channels=0", "model.deform.channels must be an integer >= 1"),
        ("model.kind=gps model.channels=50", "<= 768 and a multiple of 24, not 50"),
        (f"{DYNAMIC} model.deform=mlp", "model.deform is a section"),
    ],
)
def test_wrong_overrides_are_named_with_what_is_allowed(overrides: str, part: str) -> None:
    words = overrides.split(" model.") if overrides.startswith("model.kind=") else [overrides]
    words = [words[0], *(f"model.{word}" for word in words[1:])]
    message = refusal(None, ROOT, *words)
    assert words[-1].partition("=")[0] in message
    assert part in message


def test_a_list_that_is_too_short_is_not_called_missing() -> None:
    message = refusal(None, ROOT, "init.kind=scene", "init.scene=a.ply", "init.box=[1, 2]")
    assert "init.box must be" in message
    assert "required" not in message


def test_paths_hold_no_nul() -> None:
    assert "contains a character that is invalid in names and paths" in refusal(
        None, 'data.root="/a/\\x00"'
    )


@pytest.mark.parametrize(
    ("text", "place", "part"),
    [
        ("train:\n\tsteps: 5\n", ":2", "tab"),
        ("train:\n  steps: 5\n  steps: 6\n", ":3", "duplicate key train.steps"),
        ("train:\n  steps: 5\n  stesp: 6\n", ":3", "did you mean 'train.steps'"),
        ("train:\n  steps: [1\n", ":3", "not valid YAML"),
        ("run: &a {seed: 1}\ntrain: *a\n", ":2", "aliases"),
        ("run:\n  name: x\x05y\n", "", "not valid YAML"),
        ("train.steps: 5\n", ":1", "nested"),
        ("? [a]\n: 1\n", ":1", "keys must be plain words"),
        ("run: {<<: {name: x}}\n", ":1", "unknown key 'run.<<"),
        ("run: {seed: -1}\n", ":1", "run.seed must be an integer >= 0"),
        ("model:\n  deform:\n    width: 5\n", ":3", "model.deform belongs to model.kind=dynamic"),
        ("- a\n- b\n", "", "must be a mapping"),
        ("run: " + "[" * 5000, "", "nested too deeply"),
        ("run: {seed: [" + "1:1," * 60_000 + "]}\n", ":1", "run.seed must be an integer >= 0"),
        ("#" * (MAX_BYTES + 1), "", "bytes"),
    ],
)
def test_wrong_files_are_named_with_the_line(
    text: str, place: str, part: str, tmp_path: Path
) -> None:
    preset = write(tmp_path, text)
    message = refusal(preset, ROOT)
    assert message.startswith(f"{preset}{place}: ")
    assert part in message
    assert len(message) < 500


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_bytes(b"run: {name: \xe9}\n")
    assert "cannot be read" in refusal(tmp_path / "mine.yaml", ROOT)


@pytest.mark.parametrize("text", ["", "# nothing\n", "train:\n", "train: {}\n"])
def test_empty_means_the_defaults(text: str, tmp_path: Path) -> None:
    assert load_config(write(tmp_path, text), [ROOT]) == load_config(None, [ROOT])


def test_a_missing_capture_is_asked_for() -> None:
    assert "data.root is required" in refusal(None)


@settings(max_examples=25, deadline=None)
@given(text=st.text(max_size=60))
def test_any_text_gives_a_configuration_or_a_dyngs_error(text: str) -> None:
    with suppress(DyngsError):
        load_config(None, [ROOT, text])


# ------------------------------------------------------------------------------------------ saving

rates = st.floats(min_value=1e-30, max_value=1e30)
fractions = st.floats(min_value=0, max_value=1)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
configs = st.builds(
    Config,
    data=st.builds(
        DataConfig,
        root=st.text("abc: #'\"~-é", min_size=1).map(lambda s: Path("x" + s)),
        longest_side=st.none() | st.integers(1, 9999),
    ),
    model=st.builds(
        StaticModel, rasterize_mode=st.sampled_from(RasterizeMode), filter_3d=st.booleans()
    )
    | st.builds(
        DynamicModel,
        motion_from=fractions,
        deform=st.builds(
            HexplaneField,
            levels=st.lists(st.integers(1, 9), min_size=1).map(tuple),
            lr_planes=rates,
        )
        | st.builds(MlpField, lr=rates, moves=st.just(("scales",)))
        | st.builds(ControlNodesField, rigidity=rates),
    ),
    init=st.builds(RandomInit, half_extent=st.just("auto") | st.floats(1e-30, 1e9)),
    strategy=st.builds(McmcStrategy, noise=rates)
    | st.builds(DefaultStrategy, prune_opacity=fractions),
    optim=st.builds(OptimConfig, lr_means=rates, lr_scales=rates),
    train=st.builds(TrainConfig, steps=st.integers(1, 10**9), ssim_weight=fractions),
    run=st.builds(RunConfig, name=names, seed=st.integers(0, 2**63 - 1)),
)


@settings(max_examples=25, deadline=None)
@given(config=configs)
def test_saving_and_loading_round_trips(
    config: Config, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("run")
    save_config(config, folder / "config.yaml")
    assert load_resolved(folder) == config
    assert [f.name for f in folder.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize("name", ["a\x85b", "\u2028", "\u2029é", "é", "a\nb", "\ufeff", "😀"])
def test_odd_names_come_back(name: str, tmp_path: Path) -> None:
    config = load_config(None, [ROOT]).model_copy(update={"run": RunConfig(name=name)})
    save_config(config, tmp_path / "config.yaml")
    assert load_resolved(tmp_path) == config


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="not a run folder"):
        load_resolved(tmp_path)
    with pytest.raises(DyngsError, match="not a run folder"):
        load_resolved(tmp_path / "nowhere")


@pytest.mark.parametrize("text", ["", "train: {steps: 3}", "data:"])
def test_an_emptied_config_of_a_run_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(DyngsError, match=r"config\.yaml: data\.root, .* is missing; restore"):
        load_resolved(tmp_path)


def test_folders_of_data_are_absolute_so_that_later_commands_find_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = load_config("human", ["data.root=capture", "data.body=fits/ann"]).data
    assert (data.root, data.body) == (tmp_path / "capture", tmp_path / "fits" / "ann")
    assert load_config("human", ["data.root=capture"]).data.body is None


def test_a_run_of_an_earlier_version_may_have_a_removed_key_that_had_no_effect(
    tmp_path: Path,
) -> None:
    save_config(load_config("human", [ROOT]), tmp_path / "config.yaml")
    text = (tmp_path / "config.yaml").read_text(encoding="utf-8")
    for value, works in (("false", True), ("true", False)):
        (tmp_path / "config.yaml").write_text(
            text.replace("model:\n", f"model:\n  loose: {value}\n"), encoding="utf-8"
        )
        if works:
            assert load_resolved(tmp_path).model.kind == "human"
        else:
            with pytest.raises(DyngsError, match=r"unknown key 'model\.loose'"):
                load_resolved(tmp_path)


@pytest.mark.parametrize("kind", REMOVED_MODEL_KEYS)
def test_runs_of_earlier_versions_with_keys_of_one_kind_are_read(kind: str, tmp_path: Path) -> None:
    model = {"kind": kind} | REMOVED_MODEL_KEYS[kind]
    text = yaml.safe_dump({"data": {"root": "capture"}, "model": model})
    (tmp_path / RESOLVED_NAME).write_text(text)
    assert load_resolved(tmp_path).model.kind == kind
    changed = next(key for key in REMOVED_MODEL_KEYS[kind])
    text = yaml.safe_dump({"data": {"root": "capture"}, "model": model | {changed: 7}})
    (tmp_path / RESOLVED_NAME).write_text(text)
    with pytest.raises(DyngsError, match=f"unknown key 'model.{changed}'"):
        load_resolved(tmp_path)


def test_image_size_limit_and_downscale() -> None:
    """A requested ``downscale`` replaces the default limit; a limit of 0 is none."""
    for overrides, limit in (
        ([], 1600),
        (["data.longest_side=0"], None),
        (["data.downscale=2"], None),
        (["data.downscale=2", "data.longest_side=900"], 900),
    ):
        assert load_config("static", ["data.root=a", *overrides]).data.longest_side == limit, (
            overrides
        )


def test_replace_is_as_an_override_and_keeps_what_was_requested() -> None:
    config = load_config(Path("static"), ["data.root=x", "optim.lr_sh_dc=0.1"])
    words = ["data.root=x", "optim.lr_sh_dc=0.1", "strategy.kind=mcmc", "train.steps=10"]
    wanted = load_config(Path("static"), words)
    for found in (
        config.replace({"strategy.kind": "mcmc", "train.steps": 10}),
        config.replace(strategy={"kind": "mcmc"}, train={"steps": 10}),
    ):
        assert found == wanted
        for section in ("optim", "strategy", "train"):
            requested = getattr(found, section).model_fields_set
            assert requested == getattr(wanted, section).model_fields_set, section
    for changes, message in (
        ({"train.stpes": 1}, "unknown key 'train.stpes'; did you mean 'train.steps'"),
        ({"train": {"steps": "x"}}, "train.steps='x': train.steps must be an integer >= 1, not x"),
        ({"train": 3}, "train is a section, not a value"),
    ):
        with pytest.raises(DyngsError, match=re.escape(message)):
            config.replace(changes)
