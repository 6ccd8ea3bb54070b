"""Commands, Python examples, links and generated pages of README.md and docs/.

Every ``dyngs`` command in a block of shell is parsed with the real parser and configuration. The
commands of ``RUN_PAGES`` are run, shortened, in a folder with a tiny capture. Commands in sentences
and in blocks of text are checked for the names of their options, ``key=value`` for keys and values.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from moving_scene import write_moving_run

import dyngs
from dyngs.cli import main, make_parser
from dyngs.cli.train import parse_config
from dyngs.config.io import load_config, packaged_presets
from dyngs.config.schema import config_keys
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture

ROOT = Path(__file__).parents[1]
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]*)`")
LINK = re.compile(r"\]\((?!http|mailto)([^)#\s]*)#?([^)\s]*)\)")

RUN_PAGES = (
    "README.md",
    "docs/start/first-scene.md",
    "docs/guides/masks.md",
    "docs/guides/smaller-and-faster.md",
)
SHORTER = {
    "data synth": ("--size", "16", "--views", "6"),
    "train": ("train.steps=3", "run.threads=1", "init.kind=random", "init.num_random=80"),
    "render": ("--threads", "1"),
    "eval": ("--threads", "1"),
}
"""Arguments that are appended to a command before it is run."""
NOT_RUN = {
    "demo": "trains 3,000 steps; tests/test_demo.py runs it with fewer",
    "data sfm": "needs photos that match; tests/capture/test_sfm.py has some",
    "view": "serves a page until it is stopped; tests/view opens it in a browser",
    "predict": "needs a trained network; tests/cli/test_predict.py has one",
    "prune": "fine-tunes a dozen candidates; tests/cli/test_prune.py runs it with fewer steps",
    "tradeoff": "measures dozens of variants; tests/cli/test_study.py runs it with fewer",
}
"""Commands that are parsed only, with the reason."""
OTHER_PROGRAMS = (
    "pip", "pytest", "python", "cmake", "ctest", "git", "mkdocs", "cd", "export", "for", "seq",
    "done", "eval", "source", "if", "then", "else", "fi", "srun",
)  # fmt: skip
NOT_COMMANDS = {
    "dyngs avatar": "the header of an avatar file",
    "dyngs time t": "the header of a .ply",
}
"""Code that begins like a command."""

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
    """The words after ``dyngs`` of a command on a page."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: dyngs {' '.join(self.words)}"

    @property
    def verb(self) -> str:
        return " ".join(self.words[: 2 if self.words[0] == "data" else 1])


def blocks(text: str, *languages: str) -> list[str]:
    """Return the fenced blocks of a page in some languages."""
    return [block for language, block in BLOCK.findall(text) if language in languages]


def split_commands(block: str) -> Iterator[list[str]]:
    """Yield the words of each simple command in a block of shell; variables are replaced by 1."""
    for line in re.sub(r"\\\n\s*", " ", block).splitlines():
        line = re.sub(r"\$\w+|\$\{\w+\}", "1", line)
        lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|()")
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
    """Return the words after ``dyngs`` or ``-m dyngs``; None where another program is called."""
    if words[0] == "dyngs":
        return tuple(words[1:])
    if words[0] in ("python", "torchrun") and "-m" in words[:-1]:
        module = words.index("-m") + 1
        return tuple(words[module + 1 :]) if words[module] == "dyngs" else None
    return None


def shell_commands() -> Iterator[tuple[str, list[str]]]:
    """Yield page and words of every command in a block of shell."""
    for page, text in PAGES.items():
        for block in blocks(text, "bash", "sh"):
            for words in split_commands(block):
                yield page, words


def dyngs_commands() -> list[Command]:
    called = ((page, dyngs_words(words)) for page, words in shell_commands())
    return [Command(page, words) for page, words in called if words is not None]


# --------------------------------------------------------------------------------- parsing


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[argparse.Namespace]:
    """Replace the commands: they only append their arguments to this list."""
    calls: list[argparse.Namespace] = []
    modules = [module for name, module in sys.modules.items() if name.startswith("dyngs.cli.")]
    for module in modules:
        for name in [name for name in vars(module) if re.match(r"run(_|$)", name)]:
            monkeypatch.setattr(module, name, lambda arguments: calls.append(arguments) or 0)
    return calls


@cache
def require_overrides(*overrides: str) -> None:
    """Raise DyngsError if no kind of run accepts these ``key=value``."""
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


def with_root(words: list[str]) -> list[str]:
    """Replace the path of a capture, which does not exist here, by ``data.root``."""
    names = [word for word in words if "=" not in word]
    presets = [name for name in names if name in packaged_presets() or name.endswith(".yaml")]
    roots = [f"data.root={name}" for name in names if name not in presets]
    assert len(roots) <= 1
    return [*(presets or ["static"]), *roots, *(word for word in words if "=" in word)]


def require_valid(command: Command, arguments: argparse.Namespace) -> None:
    """Check what a command names besides options: keys, variations, times, presets, files."""
    from dyngs.export.camera_paths import camera_path_file, parse_times
    from dyngs.study.tradeoff import parse_variations

    for word in command.words:
        if word.startswith(("configs/", "benchmarks/", "examples/")):
            assert (ROOT / word).is_file(), f"{command}: there is no {word}"
        assert not Path(word.partition("=")[2] or word).is_absolute(), f"{command}: absolute path"
    overrides = [word for word in getattr(arguments, "overrides", []) if "=" in word]
    if command.verb == "train" and arguments.resume is None:
        parse_config(with_root(arguments.overrides), None, arguments.begun)
    elif command.verb == "tradeoff":
        parse_variations(arguments.vary)
    elif overrides:
        require_overrides(*overrides)
    if getattr(arguments, "times", None) is not None:
        parse_times(arguments.times)
    if getattr(arguments, "path", None) is not None and command.verb == "render":
        camera_path_file(arguments.path)


def test_commands_parse_with_valid_configuration(
    parsed: list[argparse.Namespace], capsys: pytest.CaptureFixture[str]
) -> None:
    for command in {x.words: x for x in dyngs_commands()}.values():
        if "model.kind=toy" in command.words:
            continue  # tests/models/test_kind.py trains it
        assert main(list(command.words)) == 0, f"{command}\n{capsys.readouterr().err}"
        try:
            require_valid(command, parsed[-1])
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
def test_misspelt_option_or_key_is_noticed(words: str, parsed: list[argparse.Namespace]) -> None:
    command = Command("nowhere.md", tuple(words.split()))
    if main(list(command.words)) == 0:
        with pytest.raises(DyngsError, match="unknown key"):
            require_valid(command, parsed[0])
    else:
        assert "--splt" in command.words


def test_other_programs_have_the_files_options_and_extras_of_the_pages() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for page, words in shell_commands():
        if dyngs_words(words) is not None:
            continue
        line = f"{page}: {' '.join(words)}"
        program = Path(words[0]).name
        assert program in OTHER_PROGRAMS or words[0].startswith((".ci/", "build/")), line
        if program == "pip":
            for extras in re.findall(r"\[([\w,]+)\]", line):
                for name in extras.split(","):
                    assert re.search(rf"^{name} = \[", project, re.MULTILINE), line
        if program == "python" and words[1].endswith(".py"):
            source = (ROOT / words[1]).read_text(encoding="utf-8")
            own = words[: words.index("--")] if "--" in words else words
            for option in (word for word in own if word.startswith("--")):
                assert f'"{option}"' in source, f"{line}: no option {option}"


@cache
def options_of(*verb: str) -> set[str]:
    """Return the options of a command and of the commands that contain it."""
    parser: argparse.ArgumentParser = make_parser()
    options: set[str] = set()
    while True:
        options |= {option for action in parser._actions for option in action.option_strings}
        below = [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        name = next((word for word in verb if below and word in below[0]), None)
        if name is None:
            return options
        parser = below[0][name]  # pyright: ignore[reportArgumentType]


def mentions(text: str) -> Iterator[str]:
    """Yield commands in sentences and in blocks of text, which may leave words out."""
    yield from re.findall(r"`(dyngs [^`\n]*)`", BLOCK.sub("", text))
    for block in blocks(text, "", "text"):
        for line in block.splitlines():
            if re.match(r"(\$ )?dyngs ", line):
                yield line.lstrip("$ ")


def test_commands_in_sentences_have_the_options_that_they_name() -> None:
    verbs = next(
        a.choices for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    assert verbs is not None
    for page, text in PAGES.items():
        for mention in mentions(text):
            words = mention.split()
            if mention in NOT_COMMANDS or words[1].startswith("-") or words[1].isupper():
                continue
            assert words[1] in verbs, f"{page}: `{mention}`: no such command"
            for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", mention):
                assert option in options_of(*words[1:3]), f"{page}: `{mention}`: no {option}"


def test_keys_in_sentences_are_configuration_keys() -> None:
    keys = {key.name for key in config_keys()}
    for page, text in PAGES.items():
        for code in CODE.findall(BLOCK.sub("", text)):
            words = [
                word for word in code.split() if re.fullmatch(r"[a-z]\w*(\.[a-z]\w*)+=\S+", word)
            ]
            for word in words:
                name = word.partition("=")[0]
                assert name in keys or name.endswith(".key"), f"{page}: `{code}`: no key {name}"
            try:
                require_overrides(
                    *(word for word in words if not PLACEHOLDER.search(word.partition("=")[2]))
                )
            except DyngsError as error:
                pytest.fail(f"{page}: `{code}`: {error}")


# ------------------------------------------------------------------------------ links, pages


def test_links_anchors_and_named_files_exist() -> None:
    for page, text in PAGES.items():
        for name in re.findall(r"`((?:dyngs|tests|csrc|benchmarks|examples)/[\w/.]+)`", text):
            assert (ROOT / name).exists(), f"{page}: there is no {name}"
        for file, anchor in LINK.findall(BLOCK.sub("", text)):
            target = (ROOT / page).parent / file if file else ROOT / page
            assert target.exists(), f"{page}: there is no {file}"
            if anchor:
                assert anchor in anchors_of(target), f"{page}: {file} has no section {anchor}"


@cache
def anchors_of(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as the site names them."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {
        re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles
    }


def test_generated_pages_are_up_to_date() -> None:
    """Run ``python docs/generate.py`` if this fails."""
    for path, text in generator().pages().items():
        assert path.read_text(encoding="utf-8") == text, path.name


def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    path = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = path  # generate.py adds the checkout, whose core may not be compiled
    return module


def test_navigation_has_all_pages_of_the_site() -> None:
    listed = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    pages = {page.removeprefix("docs/") for page in PAGES if page.startswith("docs/")}
    assert len(listed) == len(set(listed))
    assert set(listed) == pages


def test_all_packages_are_in_the_table() -> None:
    rows = re.findall(r"^\| `dyngs/(\w+)` \|", PAGES["docs/contributing/code.md"], re.MULTILINE)
    assert sorted(rows) == sorted(
        path.parent.name for path in (ROOT / "dyngs").glob("*/__init__.py")
    )


# --------------------------------------------------------------------------------- running


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with a static capture and a run of a moving scene, under the names in use."""
    write_static_capture(
        tmp_path / "PATH", StaticOptions(size=16, num_train=4, num_test=2, samples=1)
    )
    (tmp_path / "runs").mkdir()
    write_moving_run(tmp_path / "moving").rename(tmp_path / "runs" / "dance")
    for name in ("plush", "dog"):
        shutil.copytree(tmp_path / "runs" / "dance", tmp_path / "runs" / name)
    for name in ("scene", "object", "photos"):
        shutil.copytree(tmp_path / "PATH", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shorten(command: Command) -> list[str]:
    """Return a command with fewer steps, frames and cameras."""
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
        times = words.index("--times") + 1
        words[times] = re.sub(r":\d+$", ":3", words[times])
    elif "--path" in words:
        extra = (*extra, "--frames", "3")
    return [*words, *extra]


@pytest.mark.usefixtures("one_thread", "workplace", "short_fits")
@pytest.mark.parametrize("page", RUN_PAGES)
def test_commands_of_these_pages_run(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (command for command in dyngs_commands() if command.page == page):
        if not {command.words[0], command.verb} & NOT_RUN.keys():
            assert main(shorten(command)) == 0, f"{command}\n{capsys.readouterr().err}"


@pytest.mark.usefixtures("one_thread", "workplace")
@pytest.mark.parametrize(
    ("page", "code"),
    [(page, code) for page, text in PAGES.items() for code in blocks(text, "python")],
    ids=lambda x: x[:24],
)
def test_python_examples_run(page: str, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in set(re.findall(r"\bdyngs\.(\w+)\(", code)):
        assert hasattr(dyngs, name), f"{page}: there is no dyngs.{name}"
    train = dyngs.train
    compare = dyngs.compare

    def train_shortly(*arguments: Any, **keys: Any) -> dyngs.GaussianScene:
        few = {"run.threads": 1, "init.kind": "random", "init.num_random": 80}
        steps = {"steps": 6} if "resume" in keys else {"steps": 3, **few}
        return train(*arguments, **{**keys, **steps})

    def compare_shortly(*arguments: Any, **keys: Any) -> object:
        few = {"steps": 2, "threads": 1, "overrides": ["init.kind=random", "init.num_random=80"]}
        return compare(*arguments, **{**keys, **few})

    monkeypatch.setattr(dyngs, "train", train_shortly)
    monkeypatch.setattr(dyngs, "compare", compare_shortly)
    exec(compile(code, page, "exec"), {})
