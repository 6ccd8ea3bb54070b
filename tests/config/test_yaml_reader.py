"""Whatever YAML makes of a preset or an override: a configuration, or one line that says where and
what."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest
from refused import error_line

from dyngs.config.io import load_config, load_resolved, packaged_preset, save_config
from dyngs.config.schema import config_keys
from dyngs.config.yaml_reader import MAX_BYTES, MAX_DEPTH, read_file
from dyngs.core.errors import DyngsError

ROOT = "data.root=/x"
ODD = (
    *(
        "2024-02-30",
        "2024-99-99 1:2:3",
        "0000-01-01",
        "0x_",
        "0b_",
        "0o_",
        "9" * 5000,
        "0x" + "f" * 4000,
        "1e400",
        "-1e400",
    ),
    *(
        ".inf",
        "-.inf",
        ".nan",
        "!!int abc",
        "!!int ''",
        "!!float x",
        "!!timestamp x",
        "!!timestamp 2024-99-99",
    ),
    *(
        "!!binary é",
        "!!bool maybe",
        "!!set {a, b}",
        "!!omap [a: 1]",
        "!!python/object:os.system x",
        "!unknown x",
    ),
    *(
        "&a 1",
        "*a",
        "[1, 2]",
        "[",
        "{",
        "{? [a] : b}",
        "{<<: {a: 1}}",
        "{a: 1, a: 2}",
        "=",
        "<<",
        "''",
        '"\\x00"',
        '"\\ud800"',
    ),
    *(
        "\x00",
        "\x1b[31m",
        "\ud800",
        "\t1",
        "- a",
        "? a",
        "| x",
        "%YAML 1.1",
        "---",
        "@x",
        "`x",
        "190:20:30",
    ),
    *("[" * 5000, "{a: " * 2000, "a" * 100_000, "[2024-02-30]", "!!int [1]", "!!merge <<"),
)


def refused(preset: Path | None, *overrides: str) -> str:
    """What is said about a configuration that must be refused: one short line of printable
    characters."""
    with pytest.raises(DyngsError) as caught:
        load_config(preset, overrides)
    text = str(caught.value)
    assert text.isprintable(), text
    assert len(text) < 500
    return text


@pytest.mark.parametrize(
    "text",
    ["2024-02-30", "2024-01-01", "0x_", "1e400", "9" * 200, "12:30", "!!int abc", "nan", "[a"],
)
def test_a_name_may_look_like_anything_else(text: str) -> None:
    assert load_config(None, [ROOT, f"run.name={text}"]).run.name in (
        text,
        text.removeprefix("!!int "),
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0x_", "train.steps=0x_: train.steps must be an integer >= 1, not '0x_'"),
        ("!!int abc", "must be an integer >= 1, not 'abc'"),
        ("9" * 5000, "must be an integer >= 1, not '9999"),
        ("0x" + "f" * 4000, "must be an integer >= 1, not '0xff"),
        ("9" * 30, "train.steps must be below 2^63, not 9999"),
        (".inf", "must be an integer >= 1, not inf"),
        ("1e400", "must be an integer >= 1, not inf"),
        ("2024-02-30", "must be an integer >= 1, not '2024-02-30'"),
        ("!!timestamp x", "must be an integer >= 1, not 'x'"),
        ("{a: 1, a: 2}", "duplicate key train.steps.a"),
        ("[" * 5000, "must be an integer >= 1, not '[[["),
    ],
)
def test_odd_values_are_named_with_what_is_allowed(text: str, said: str) -> None:
    message = refused(None, ROOT, f"train.steps={text}")
    assert message.startswith("train.steps=")
    assert said in message


@pytest.mark.parametrize("text", [f"/a/{chr(0)}b", '"/a/\\x00"', '"\\ud800"'])
def test_paths_hold_no_nul_and_no_half_characters(text: str) -> None:
    assert "holds a character that no name or path may hold; remove it" in refused(
        None, f"data.root={text}"
    )


def test_a_path_that_is_not_utf8_is_kept(tmp_path: Path) -> None:
    """The shell hands over bytes that are no UTF-8 as surrogates."""
    config = load_config(None, ["data.root=/scans/caf\udce9"])
    assert str(config.data.root) == "/scans/caf\udce9"
    save_config(config, tmp_path / "config.yaml")
    assert load_resolved(tmp_path / "config.yaml") == config


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            b"train:\n  steps: 2024-02-30\n",
            "file.yaml:2: train.steps must be an integer >= 1, not '2024-02-30'",
        ),
        (
            b"run:\n  name: x\x05y\n",
            r"file.yaml:2: not valid YAML: the control character '\x05'; remove it",
        ),
        (b"run:\n\tname: x\n", "file.yaml:2: not valid YAML: a tab where YAML wants spaces"),
        (b"run: {name: \xe9}\n", "file.yaml: not a text file in UTF-8"),
        (b"run: {name: a}\nrun: {name: b}\n", "file.yaml:2: duplicate key run"),
        (b"run: {? [a] : b}\n", "file.yaml:1: keys must be plain words"),
        (b"run: &a {name: x}\ntrain: *a\n", "file.yaml:2: not valid YAML: aliases"),
        (b"run: {<<: {name: x}}\n", "unknown key 'run.<<"),
        (b"run: " + b"[" * 5000, "file.yaml:1: not valid YAML: nested too deeply"),
        (b"".join(b" " * i + b"k:\n" for i in range(MAX_DEPTH + 2)), "nested too deeply"),
        (
            b"run: {seed: " + b"9" * 5000 + b"}\n",
            "run.seed must be an integer >= 0 and < 9.22337e+18, not '9999",
        ),
        (
            b"run:\n  seed: [2024-02-30]\n",
            "run.seed must be an integer >= 0 and < 9.22337e+18, not ['2024-02-30']",
        ),
        (
            b"run: {seed: 1" + b":5" * 130_000 + b"}\n",
            "run.seed must be an integer >= 0 and < 9.22337e+18, not '1:5:5",
        ),
        (b"run: {seed: !!int '_1" + b":5" * 130_000 + b"'}\n", "run.seed must be an integer >= 0"),
        (b"run: {seed: !!float 1" + b":5" * 130_000 + b".5}\n", "run.seed must be an integer >= 0"),
        (b"run: {seed: 0x" + b"f" * 260_000 + b"}\n", "run.seed must be an integer >= 0"),
        (b"run: {seed: [" + b"1:1," * 60_000 + b"]}\n", "run.seed must be an integer >= 0"),
        (
            b"run: {seed: 12:30}\n",
            "run.seed must be an integer >= 0 and < 9.22337e+18, not '12:30'",
        ),
        (b"#" * (MAX_BYTES + 1), "larger than 256 KiB"),
        (b"- a\n", "must be a mapping of sections"),
        (b"a: 1\n---\nb: 2\n", "file.yaml:2: not valid YAML"),
    ],
)
def test_files_are_read_or_refused_with_their_line(tmp_path: Path, data: bytes, said: str) -> None:
    file = tmp_path / "file.yaml"
    file.write_bytes(data)
    start = time.process_time()
    assert said in refused(file, ROOT)
    assert time.process_time() - start < 5


def test_a_byte_order_mark_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "file.yaml").write_bytes(b"\xef\xbb\xbfdata: {root: /x}\n")
    assert load_config(tmp_path / "file.yaml").data.root == Path("/x")


def test_a_file_is_read_as_it_is_by_now_and_what_is_read_belongs_to_the_reader(
    tmp_path: Path,
) -> None:
    file = tmp_path / "a.yaml"
    for number in (1, 2):
        file.write_text(f"train: {{steps: {number}, eval_at: []}}\nstrategy: {{}}\n")
        for _ in range(2):  # also where it was read before
            leaves = read_file(file)
            assert [leaf.value for leaf in leaves] == [number, [], {}]
            leaves[1].value.append(7)
            leaves[2].value["start"] = 8


def test_mutated_overrides_and_presets_end_in_a_configuration_or_one_line(tmp_path: Path) -> None:
    chance = random.Random(0)
    keys = [key.name for key in config_keys()]
    presets = [packaged_preset(name).read_bytes() for name in ("static", "dynamic", "human")]
    file = tmp_path / "file.yaml"
    told = []
    for trial in range(200):
        data = bytearray(chance.choice(presets))
        overrides = [ROOT]
        for _ in range(chance.randint(1, 3)):
            if trial % 2:
                overrides.append(f"{chance.choice(keys)}={chance.choice(ODD)}")
                continue
            place = chance.randrange(len(data))
            bad = chance.choice(
                (
                    b"\x00",
                    b"\xff",
                    b"\t",
                    b"*a",
                    b"[",
                    b"{",
                    b": ",
                    b"? ",
                    b"\xe2\x80\xa8",
                    b"",
                    bytes([chance.randrange(256)]),
                )
            )
            data[place : place + chance.randint(0, 4)] = bad
        file.write_bytes(data)
        try:
            config = load_config(file, overrides)
        except DyngsError as error:
            told.append(str(error))
        else:
            save_config(config, tmp_path / "config.yaml")
            assert load_resolved(tmp_path / "config.yaml") == config
    assert len(told) > 100
    assert all(text.isprintable() and len(text) < 500 for text in told)


def test_the_command_line_says_it_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ODD:
        assert len(error_line(capsys, "train", "data.root=/nowhere", f"train.steps={text}")) < 600


@pytest.mark.parametrize("text", ["1:30", "0:90", "1:60:60", "-1:30"])
def test_numbers_of_base_60_are_none(text: str) -> None:
    assert "must be an integer" in refused(None, ROOT, f"train.steps={text}")


def test_a_leading_zero_changes_no_number() -> None:
    assert load_config(None, [ROOT, "train.steps=010"]).train.steps == 10
    assert load_config(None, [ROOT, "optim.lr_means=0.5"]).optim.lr_means == 0.5
    assert load_config(None, [ROOT, "run.name=007"]).run.name == "007"
