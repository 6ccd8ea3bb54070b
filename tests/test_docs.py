"""The commands and the Python examples of README.md and docs/*.md: none may name an option or a key
that is not there.

Every ``dyngs`` command in a block of shell goes through the real parser and the real configuration;
those of the pages in ``RUN_PAGES`` are run, shortened, in a folder with a tiny capture. Commands
within sentences and outlines of commands (blocks of text) are checked for the names of their
options, and ``key=value`` for keys and values.
"""

from __future__ import annotations

import argparse
import ast
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from moving_scene import write_moving_run

import dyngs
from dyngs.cli import main, make_parser
from dyngs.cli.train import parse_config
from dyngs.config.io import load_config
from dyngs.config.schema import config_keys
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StillOptions, write_still_capture

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]*)`")
SHELL = ("bash", "sh")
PYTHON = ("python",)
OUTLINE = ("", "text")

RUN_PAGES = (
    "README.md", "storage.md", "photos.md", "video.md", "person.md", "mask.md", "look.md", "longer.md", "smaller.md",
    "faster.md", "edit.md",
)  # fmt: skip
SHORTER = {
    "data synth": ("--size", "16", "--views", "6"),
    "train": ("train.steps=3", "run.threads=1", "init.kind=random", "init.num_random=80"),
    "render": ("--threads", "1"),
    "eval": ("--threads", "1"),
}
"""Appended where a command is run."""
NOT_RUN = {
    "demo": "trains 3,000 steps; tests/test_demo.py runs it with fewer",
    "data sfm": "needs photos with something to match; tests/capture/test_sfm.py has some",
    "view": "serves a page until it is stopped; tests/view opens it in a browser",
    "predict": "needs a trained network; tests/cli/test_predict.py has one",
    "prune": "fine-tunes a dozen candidates; tests/cli/test_prune.py does it with fewer steps",
    "tradeoff": "measures dozens of variants; tests/cli/test_study.py does it with fewer",
}
"""Commands that are only parsed, with the reason."""
OTHER_PROGRAMS = {
    "pip": "installs packages; what it asks for is compared with pyproject.toml below",
    "pytest": "runs this test",
    "python": "a script of the repository: its file and the names of its options are compared below",
    "cmake": "another build; a stage of .ci/run",
    "export": "of the shell",
    "for": "of the shell",
    "test_": "a program that another build makes",
    "seq": "of the shell",
    "done": "of the shell",
}
NOT_COMMANDS = {
    "dyngs avatar": "what the header of an avatar file says",
    "dyngs time t": "what the header of a .ply says",
}

KINDS = (
    (),
    ("colour.kind=network",),
    ("strategy.kind=mcmc",),
    ("init.kind=random",),
    ("init.kind=scene", "init.scene=x"),
    *(
        ("model.kind=dynamic", f"model.deform.kind={kind}")
        for kind in ("mlp", "hexplane", "control_nodes")
    ),
)
PRESETS = ("static", "dynamic", "human", "human_predictor", "ngp")
PLACEHOLDER = re.compile(r"[A-Z]|\.\.\.|start:stop:step|value|X,Y")


@dataclass(frozen=True)
class Command:
    """A command of a page: the words after ``dyngs``."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: dyngs {' '.join(self.words)}"

    @property
    def verb(self) -> str:
        return " ".join(self.words[: 2 if self.words[0] == "data" else 1])


def blocks(page: Path, languages: tuple[str, ...]) -> Iterator[str]:
    """Fenced blocks of a page in some languages."""
    yield from (
        text
        for language, text in BLOCK.findall(page.read_text(encoding="utf-8"))
        if language in languages
    )


def segments(block: str) -> Iterator[list[str]]:
    """The simple commands of a block of shell, as words; comments are left out, variables stand for
    1."""
    for line in re.sub(r"\\\n\s*", " ", block).splitlines():
        lexer = shlex.shlex(
            re.sub(r"\$\w+|\$\{\w+\}", "1", line), posix=True, punctuation_chars=";&|()"
        )
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if set(word) <= set(";&|()$"):
                if words:
                    yield words
                words = []
            elif words or (word not in ("do", ".") and not re.fullmatch(r"[A-Z_]+=.*", word)):
                words.append(word)


def dyngs_words(words: list[str]) -> tuple[str, ...] | None:
    """The words after ``dyngs`` or ``-m dyngs``; None where another program is called."""
    if words[0] == "dyngs":
        return tuple(words[1:])
    if words[0] in ("python", "torchrun") and words[-1] != "-m" and "-m" in words:
        at = words.index("-m")
        return tuple(words[at + 2 :]) if words[at + 1] == "dyngs" else None
    return None


def commands() -> list[Command]:
    """Every ``dyngs`` command in the blocks of shell."""
    found = []
    for page in PAGES:
        for block in blocks(page, SHELL):
            found += [
                Command(page.name, w)
                for words in segments(block)
                if (w := dyngs_words(words)) is not None
            ]
    return found


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[argparse.Namespace]:
    """What commands are called with: they do nothing but note it here."""
    found: list[argparse.Namespace] = []
    modules = [module for name, module in sys.modules.items() if name.startswith("dyngs.cli.")]
    for module in modules:
        for name in [name for name in vars(module) if re.match(r"run(_|$)", name)]:
            monkeypatch.setattr(module, name, lambda arguments: found.append(arguments) or 0)
    return found


@cache
def require_overrides(*overrides: str) -> None:
    """Nothing, if some kind of run takes these ``key=value``. Raises DyngsError otherwise."""
    errors = []
    for preset in PRESETS:
        for kinds in KINDS:
            try:
                load_config(Path(preset), ["data.root=x", *kinds, *overrides])
            except DyngsError as error:
                errors.append(error)
            else:
                return
    raise errors[0]


def require_sound(command: Command, arguments: argparse.Namespace) -> None:
    """Nothing, if what a parsed command names besides its options can be: keys, variations, times,
    presets."""
    from dyngs.export.camera_paths import parse_times, camera_path_file
    from dyngs.study.tradeoff import parse_goal, parse_requirements, parse_variations

    for word in command.words:
        if word.startswith(("configs/", "benchmarks/", "examples/")):
            assert (ROOT / word).is_file(), f"{command}: there is no {word}"
        assert not Path(word.partition("=")[2] or word).is_absolute(), (
            f"{command}: a path of one machine"
        )
    overrides = [word for word in getattr(arguments, "overrides", []) if "=" in word]
    if command.verb == "train" and arguments.resume is None:
        parse_config(arguments.overrides, None, arguments.begun)
    elif command.verb == "tradeoff":
        parse_variations(arguments.vary)
        parse_requirements(arguments.require or "psnr>=1")
        parse_goal(
            arguments.minimize or arguments.maximize or "psnr", smallest=bool(arguments.minimize)
        )
    elif overrides:
        require_overrides(*overrides)
    if getattr(arguments, "times", None) is not None:
        parse_times(arguments.times)
    if getattr(arguments, "path", None) is not None and command.verb == "render":
        camera_path_file(arguments.path)


def test_every_command_is_parsed_with_its_configuration(
    parsed: list[argparse.Namespace], capsys: pytest.CaptureFixture[str]
) -> None:
    for command in {x.words: x for x in commands()}.values():
        assert main(list(command.words)) == 0, f"{command}\n{capsys.readouterr().err}"
        try:
            require_sound(command, parsed[-1])
        except DyngsError as error:
            pytest.fail(f"{command}\n{error}")


@pytest.mark.parametrize(
    "words",
    [
        "eval runs/a --splt test",
        "train static data.root=x trian.steps=2",
        "prune r --out o prune.shrae=0.1",
    ],
)
def test_a_misspelt_option_or_key_is_noticed(words: str, parsed: list[argparse.Namespace]) -> None:
    command = Command("nowhere.md", tuple(words.split()))
    if main(list(command.words)) == 0:
        with pytest.raises(DyngsError, match="unknown key"):
            require_sound(command, parsed[0])
    else:
        assert "--splt" in command.words


def test_other_programs_are_known_and_their_options_there() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for page in PAGES:
        for words in (
            w for block in blocks(page, SHELL) for w in segments(block) if dyngs_words(w) is None
        ):
            program = Path(words[0]).name
            reason = [
                why
                for name, why in OTHER_PROGRAMS.items()
                if program == name or name == program[:5]
            ]
            assert reason, (
                f"{page.name}: {' '.join(words)} is neither checked nor in OTHER_PROGRAMS"
            )
            for extra in re.findall(r"\[([\w,]+)\]", " ".join(words)) if program == "pip" else ():
                for name in extra.split(","):
                    assert re.search(rf"^{name} = \[", project, re.MULTILINE), (
                        f"{page.name}: no extra {name}"
                    )
            if program == "python" and words[1].endswith(".py"):
                source = (ROOT / words[1]).read_text(encoding="utf-8")
                own = words[: words.index("--")] if "--" in words else words
                for option in (word for word in own if word.startswith("--")):
                    assert f'"{option}"' in source, f"{page.name}: {words[1]} has no {option}"


# ------------------------------------------------------------------------------------------ in
# sentences and outlines


@cache
def options_of(*verb: str) -> set[str]:
    """The options of a command and of the commands below it."""
    parser: argparse.ArgumentParser = make_parser()
    found: set[str] = set()
    while True:
        found |= {option for action in parser._actions for option in action.option_strings}
        below = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        name = next((word for word in verb if below and word in below[0]), None)
        if name is None:
            return found
        parser = below[0][name]  # pyright: ignore[reportArgumentType]


def mentions(page: Path) -> Iterator[str]:
    """Commands in sentences and in blocks of text, which may leave words out."""
    text = page.read_text(encoding="utf-8")
    yield from re.findall(r"`(dyngs [^`\n]*)`", BLOCK.sub("", text))
    for block in blocks(page, OUTLINE):
        yield from (
            line.lstrip("$ ") for line in block.splitlines() if re.match(r"(\$ )?dyngs ", line)
        )


def test_commands_in_sentences_have_the_options_that_they_name() -> None:
    verbs = next(
        a.choices for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    assert verbs is not None
    for page, mention in ((x, mention) for x in PAGES for mention in mentions(x)):
        words = mention.split()
        if mention in NOT_COMMANDS or words[1].startswith("-"):
            continue
        assert words[1] in verbs, f"{page.name}: `{mention}`: no such command"
        for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", mention):
            assert option in options_of(*words[1:3]), (
                f"{page.name}: `{mention}`: no option {option}"
            )


def test_keys_in_sentences_are_keys_of_the_configuration() -> None:
    keys = {key.name for key in config_keys()}
    found = [
        (x.name, code)
        for x in PAGES
        for code in CODE.findall(BLOCK.sub("", x.read_text(encoding="utf-8")))
    ]
    for page, code in found:
        words = [word for word in code.split() if re.fullmatch(r"[a-z]\w*(\.[a-z]\w*)+=\S+", word)]
        for word in words:
            name = word.partition("=")[0]
            assert name in keys or name == "section.key", f"{page}: `{code}`: no key {name}"
        whole = [word for word in words if not PLACEHOLDER.search(word.partition("=")[2])]
        try:
            require_overrides(*whole)
        except DyngsError as error:
            pytest.fail(f"{page}: `{code}`: {error}")


def test_files_and_places_that_a_page_names_are_there() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"`((?:dyngs|tests|csrc|benchmarks|examples)/[\w/.]+)`", text):
            assert (ROOT / name).exists(), f"{page.name}: there is no {name}"
        for file, place in re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)\)", text):
            target = page.parent / file if file else page
            assert target.exists(), f"{page.name}: there is no {file}"
            assert not place or place in places_of(target), (
                f"{page.name}: {file} has no section {place}"
            )


@cache
def places_of(page: Path) -> set[str]:
    """What a link to a section of the page may name."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


# ------------------------------------------------------------------------------------------------------- really run


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with what pages begin from: a still capture and a run of a moving
    scene."""
    write_still_capture(
        tmp_path / "PATH", StillOptions(size=16, num_train=4, num_test=2, samples=1)
    )
    (tmp_path / "runs").mkdir()
    write_moving_run(tmp_path / "moving").rename(tmp_path / "runs" / "dance")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shortened(command: Command) -> list[str]:
    """The command with less to do."""
    words = list(command.words)
    extra = SHORTER.get(command.verb, ())
    if "--resume" in words:
        words = [re.sub(r"^train\.steps=\d+", "train.steps=6", word) for word in words]
        extra = ("run.threads=1",)
    elif "--from" in words:
        extra = tuple(word for word in extra if not word.startswith("init."))
    elif words[2:3] in (["room"], ["human"]):
        extra = (*extra, "--cameras", "3")
    if "--times" in words:
        at = words.index("--times") + 1
        words[at] = re.sub(r":\d+$", ":3", words[at])
    elif "--path" in words:
        extra = (*extra, "--frames", "3")
    return [*words, *extra]


@pytest.mark.usefixtures("one_thread", "workplace", "short_fits")
@pytest.mark.parametrize("page", RUN_PAGES)
def test_the_commands_of_these_pages_run(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (command for command in commands() if command.page == page):
        if not {command.words[0], command.verb} & NOT_RUN.keys():
            assert main(shortened(command)) == 0, f"{command}\n{capsys.readouterr().err}"


@pytest.mark.usefixtures("one_thread", "workplace")
@pytest.mark.parametrize(
    ("page", "code"),
    [(page.name, code) for page in PAGES for code in blocks(page, PYTHON)],
    ids=lambda x: x[:20],
)
def test_python_examples_run(page: str, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in set(re.findall(r"\bdyngs\.(\w+)\(", code)):
        assert hasattr(dyngs, name), f"{page}: there is no dyngs.{name}"
    monkeypatch.setattr(
        dyngs, "load_config", lambda preset, keys: load_config(preset, [*keys, *SHORTER["train"]])
    )
    exec(compile(code, page, "exec"), {})


def test_the_table_of_packages_repeats_their_docstrings() -> None:
    rows = re.findall(
        r"^\| `dyngs/(\w+)` \| (.+) \|$",
        (ROOT / "docs/code.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    packages = {
        path.parent.name: ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        for path in (ROOT / "dyngs").glob("*/__init__.py")
    }
    first_sentences = {k: " ".join(v.split("\n\n")[0].split()) for k, v in packages.items()}
    assert dict(rows) == first_sentences
