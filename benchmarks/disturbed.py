"""The frame of benchmarks that train on captures as they are and on copies that were made worse,
and print a table."""

from __future__ import annotations

import argparse
import re
import resource
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from dyngs.api.train import train
from dyngs.config.io import load_config, packaged_preset
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths


@dataclass(frozen=True)
class Study:
    """What is made worse, and what is tried against it.

    Attributes:
        text: of the command, for --help.
        worse: what a column calls that of which the copies are worse, "cameras"; --cameras chooses.
        given: the name of the capture as it is, in that column.
        key: the setting that is tried with never, always and auto; --NAME chooses, by its last
            part.
        disturb: writes the worse copy of a capture into a new folder, by a seed.
        columns: names of the cells that ``scores`` returns.
        scores: returns the cells of a trained run.
    """

    text: str
    worse: str
    given: str
    key: str
    disturb: Callable[[Path, Path, int], None]
    columns: Sequence[str]
    scores: Callable[[Path], Sequence[str]]


def print_table(study: Study, words: Sequence[str] | None = None) -> None:
    """Train what is not there yet, and print a row for each run."""
    options, captures, keys = _arguments(study, words)
    titles = ["capture", study.worse, study.key, *study.columns, "CPU s"]
    print(f"| {' | '.join(titles)} |\n|" + "---|" * len(titles))
    with kernel_threads(torch.get_num_threads()):
        for capture in captures:
            copy = options.folder / f"{capture.name}_disturbed"
            if not copy.exists():
                study.disturb(capture, copy, options.seed)
            for state in options.states.split(","):
                root = copy if state == "disturbed" else capture
                for setting in options.settings.split(","):
                    run = options.folder / f"{capture.name}_{state}_{setting}"
                    own = [f"data.root={root}", f"run.dir={run}", f"{study.key}={setting}", *keys]
                    seconds = _trained(run, options.preset, own)
                    cells = [capture.name, state, setting, *study.scores(run), seconds]
                    print(f"| {' | '.join(cells)} |", flush=True)


def _arguments(
    study: Study, words: Sequence[str] | None
) -> tuple[argparse.Namespace, list[Path], list[str]]:
    """Return the options, the captures, and the overrides of the configuration."""
    parser = argparse.ArgumentParser(
        description=study.text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("words", nargs="+", help="captures, and key=value")
    parser.add_argument("--preset", default="static")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        f"--{study.key.rpartition('.')[2]}", dest="settings", default="never,always,auto"
    )
    parser.add_argument(f"--{study.worse}", dest="states", default=f"{study.given},disturbed")
    options = parser.parse_intermixed_args(words)
    keys = [word for word in options.words if re.match(r"[\w.]+=", word)]
    return options, [Path(word) for word in options.words if word not in keys], keys


def _trained(run: Path, preset: str, keys: Sequence[str]) -> str:
    """Train a run that is not there; return its CPU time in seconds, empty where it was there."""
    if checkpoint_paths(run):
        return ""
    begun = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    train(load_config(packaged_preset(preset), keys))
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_utime - begun:.0f}"
