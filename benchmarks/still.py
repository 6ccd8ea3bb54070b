"""Preset dynamic against preset static, on still and on moving captures, in runs of several
lengths.

    python benchmarks/still.py runs/still lego=LEGO cup=CUP,data.times=order orbits=ORBITS --lengths
    train.steps=3000

A still capture without times gets them by its order, time = i / n, in a copy, unless it is given
data.times. A capture is a name, a folder and keys that preset dynamic alone gets. Runs that are
there are not trained again; where dynamic resolves to the config of static, that is the same run. A
length "" is that of the preset.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import torch

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config, load_resolved
from dyngs.evaluate.report import evaluate_run
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", nargs="+", help="NAME=FOLDER[,KEY=VALUE...]")
    parser.add_argument(
        "--lengths",
        nargs="*",
        default=["train.steps=500", "train.steps=3000", "train.steps=8000", ""],
    )
    parser.add_argument("--seeds", nargs="*", type=int, default=[42, 43])
    parser.add_argument("--keys", nargs="*", default=[], help="KEY=VALUE of both presets")
    options = parser.parse_args()
    print(
        "| capture | length | seed | static | dynamic | gain, dB | chosen | trial |\n|" + "---|" * 8
    )
    with kernel_threads(torch.get_num_threads()):
        for text in options.captures:
            name, _, rest = text.partition("=")
            root, *own = rest.split(",")
            folder = options.folder / name
            source = _with_times(Path(root), folder / "capture") if not own else Path(root)
            for length in options.lengths:
                for seed in options.seeds:
                    keys = [
                        f"data.root={source}",
                        f"run.seed={seed}",
                        *options.keys,
                        *length.split(),
                    ]
                    base = folder / f"{length or 'preset'}_{seed}"
                    moving = _trained(
                        load_config("dynamic", [*keys, *own, f"run.dir={base}_dynamic"])
                    )
                    still = load_config("static", [*keys, f"run.dir={base}_static"])
                    chosen = load_resolved(moving)
                    same = chosen.train.minutes is None and _differences(chosen, still) == {"run"}
                    static = moving if same else _trained(still)
                    first, second = (evaluate_run(run, "test").psnr for run in (static, moving))
                    cells = [name, length or "preset", str(seed), f"{first:.2f}", f"{second:.2f}"]
                    cells += [f"{second - first:+.2f}", chosen.model.kind, _trial(moving)]
                    print(f"| {' | '.join(cells)} |", flush=True)


def _trained(config: Config) -> Path:
    assert config.run.dir is not None
    return config.run.dir if checkpoint_paths(config.run.dir) else train(config)


def _differences(one: Config, other: Config) -> set[str]:
    return {name for name in Config.model_fields if getattr(one, name) != getattr(other, name)}


def _trial(run: Path) -> str:
    """Return gain, standard error and seconds of the trial of motion; "none" where there was
    none."""
    file = run / "choices.json"
    choices = json.loads(file.read_text()) if file.is_file() else []
    found = [x for x in choices if x["setting"] == "model.kind=dynamic"]
    return "none" if not found else "{gain:+.2f} ({error:.2f}), {seconds:.0f} s".format(**found[0])


def _with_times(root: Path, copy: Path) -> Path:
    """Return ``root``, or where its Blender JSON has no times a copy with times by order."""
    described = {file.name: json.loads(file.read_text()) for file in root.glob("transforms_*.json")}
    if not described or any("time" in frame for x in described.values() for frame in x["frames"]):
        return root
    if not copy.exists():
        shutil.copytree(root, copy)
    for name, x in described.items():
        for i, frame in enumerate(x["frames"]):
            frame["time"] = i / len(x["frames"])
        (copy / name).unlink()
        (copy / name).write_text(json.dumps(x))
    return copy


if __name__ == "__main__":
    main()
