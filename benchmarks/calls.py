"""Print the functions of dyngs that run between the call of ``dyngs.train`` and the first step, and
within one step.

Usage: python benchmarks/calls.py CAPTURE [PRESET] [--depth N]
Comprehensions and lambdas are not counted. The tree shows each function once, where it is first
called.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

import dyngs
from dyngs.api.train import train

ROOT = Path(dyngs.__file__).parent


class Recorder:
    """Calls between functions of dyngs, in the order in which they are first made."""

    def __init__(self) -> None:
        self.children: dict[tuple[str, str], list[tuple[str, str]]] = {}
        self.seen: set[tuple[str, str]] = set()
        self.is_on = True

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or not self.is_on:
            return
        called = place_of(frame)
        if called is None or called in self.seen:
            return
        caller = frame.f_back
        while caller is not None and place_of(caller) is None:
            caller = caller.f_back
        parent = ("", "") if caller is None else place_of(caller) or ("", "")
        self.seen.add(called)
        self.children.setdefault(parent, []).append(called)

    def print_tree(self, at: tuple[str, str], depth: int, most: int) -> None:
        for child in self.children.get(at, []):
            print(f"{'  ' * depth}{child[0]}: {child[1]}")
            if depth + 1 < most:
                self.print_tree(child, depth + 1, most)


def place_of(frame: FrameType) -> tuple[str, str] | None:
    """Return the file and the name of a function of dyngs, None for all others."""
    code = frame.f_code
    name = getattr(code, "co_qualname", code.co_name)
    path = Path(code.co_filename)
    if not path.is_relative_to(ROOT) or name.split(".")[-1].startswith("<"):
        return None
    return path.relative_to(ROOT).as_posix(), name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture")
    parser.add_argument("preset", nargs="?", default="static")
    parser.add_argument("--depth", type=int, default=4)
    given = parser.parse_args()
    before = Recorder()
    within = Recorder()
    within.is_on = False
    steps = 0

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal steps
        if event in ("call", "return") and place_of(frame) == STEP:
            steps += event == "call"
            before.is_on = False
            within.is_on = steps == 2 and event == "call"
        before(frame, event, argument)
        within(frame, event, argument)

    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            f"data.root={given.capture}",
            f"run.dir={folder}/run",
            "train.steps=3",
            "data.longest_side=64",
            "run.threads=1",
        ]
        config = dyngs.load_config(given.preset, overrides)
        sys.setprofile(profile)
        train(config)
        sys.setprofile(None)
    for title, recorder in (("before the first step", before), ("in the second step", within)):
        print(
            f"\n{title}: {len(recorder.seen)} functions in {len({f for f, _ in recorder.seen})} files"
        )
        for root in [key for key in recorder.children if key not in recorder.seen]:
            recorder.print_tree(root, 0, given.depth)


STEP = ("training/trainer.py", "Trainer.step")

if __name__ == "__main__":
    main()
