"""Run the published measurements, store them as JSON, and write the benchmark pages from it.

    python benchmarks/results.py list
    python benchmarks/results.py run lego400 --captures CAPTURES [--runs RUNS]
    python benchmarks/results.py write

``run`` trains and evaluates one measurement of ``MEASUREMENTS`` and stores
``benchmarks/results/NAME.json``. CAPTURES holds a folder or video per capture. ``write`` writes
docs/benchmarks/*.md, docs/results.md and the table of README.md from all stored files, so that they
cannot differ. Published figures for docs/results.md are in ``benchmarks/results/published.yaml``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from statistics import fmean
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
PAGES = ROOT / "docs/benchmarks"
PUBLISHED = RESULTS / "published.yaml"
MOVING = RESULTS / "comparisons/moving.json"  # rows of benchmarks/dynamic.py
PRUNING = RESULTS / "comparisons/pruning.json"  # rows of benchmarks/prune.py
MEGA = RESULTS / "comparisons/mega.json"  # rows of benchmarks/mega.py
TABLE_BEGIN = "<!-- results: written by benchmarks/results.py -->"
TABLE_END = "<!-- end of results -->"


@dataclass(frozen=True)
class Measurement:
    """One training run and its evaluation on the whole test split."""

    page: str  # static, moving or people; systems: in docs/results.md only
    title: str
    capture: str  # name of a folder or file in CAPTURES
    preset: str
    overrides: tuple[str, ...] = ()
    estimate_poses: bool = False  # by `dyngs data sfm` before training
    in_readme: bool = False


MEASUREMENTS = {
    "plush": Measurement(
        "static", "plush: 97 phone photos", "plush", "static",
        ("data.longest_side=640",), estimate_poses=True, in_readme=True,
    ),
    "street": Measurement(
        "static", "street: 29 photos, sky, a moving car", "street", "static",
        ("data.longest_side=480", "train.steps=5000"),
        estimate_poses=True, in_readme=True,
    ),
    "fox": Measurement(
        "static", "fox: 50 photos", "fox", "static",
        ("data.longest_side=240", "train.steps=3000"),
    ),
    "colmap_small": Measurement(
        "static", "cup: 77 photos with COLMAP poses", "colmap_small", "static",
        ("data.longest_side=400", "train.steps=3000"),
    ),
    "lego400": Measurement(
        "static", "lego (NeRF-synthetic) at 400 px", "lego400", "static",
        ("train.steps=5000",), in_readme=True,
    ),
    "lego400_blender": Measurement(
        "static", "lego, 30,000 steps", "lego400", "blender", in_readme=True
    ),
    "clip_dog": Measurement(
        "moving", "dog: a phone clip of 4 s", "clip_dog/dog.mp4", "dynamic",
        ("data.longest_side=480",), in_readme=True,
    ),
    "rig": Measurement(
        "moving", "rig: four fixed cameras", "rig", "dynamic", in_readme=True
    ),
    "clip_duck": Measurement(
        "moving", "duck: a clip, one moving camera", "clip_duck", "dynamic",
        ("data.longest_side=400",),
    ),
    "stage": Measurement(
        "moving", "stage (synthetic): eight fixed cameras", "stage", "dynamic",
        ("train.steps=10000",), in_readme=True,
    ),
    "orbits": Measurement(
        "moving", "orbits (synthetic): one view per time", "orbits", "dynamic", in_readme=True
    ),
    "flag": Measurement("moving", "flag (synthetic): one view per time", "flag", "dynamic"),
    "casual_m": Measurement(
        "people", "casual_m (synthetic): a walking man, eight cameras", "human/casual_m", "human",
        in_readme=True,
    ),
    "lego400_mip": Measurement("systems", "lego", "lego400", "mip"),
    "lego400_mcmc": Measurement("systems", "lego", "lego400", "static_mcmc"),
    "lego400_ngp": Measurement(
        "systems", "lego", "lego400", "ngp", ("data.longest_side=200",)
    ),
    "orbits_4dgs": Measurement("systems", "orbits", "orbits", "4dgs"),
    "orbits_deformable_3dgs": Measurement("systems", "orbits", "orbits", "deformable_3dgs"),
    "orbits_gaussians_4d": Measurement("systems", "orbits", "orbits", "gaussians_4d"),
    "stage_free": Measurement(
        "systems", "stage", "stage", "dynamic",
        ("model.pilot_runs=false", "model.deform.kind=free", "train.steps=10000"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Result:
    """A stored measurement. None: not measured, or does not apply."""

    command: str
    capture: str
    commit: str
    date: str
    machine: str
    threads: int
    steps: int
    image_size: str
    num_views: int | None
    psnr: float
    ssim: float | None = None
    psnr_white: float | None = None
    psnr_black: float | None = None
    psnr_moving: float | None = None
    psnr_person: float | None = None  # within the person's bounding box
    num_gaussians: int | None = None
    moving_fraction: float | None = None
    model_mb: float | None = None  # float32
    stored_mb: float | None = None  # file of `dyngs export --format dyngs`
    cpu_seconds: float | None = None  # of training and its pilot runs, all threads
    wall_seconds: float | None = None
    source: str = "measured by benchmarks/results.py"


def training_command(measurement: Measurement, root: str, run: str, threads: int) -> list[str]:
    """Return the words of `dyngs train` for a measurement."""
    return [
        "train", measurement.preset, f"data.root={root}", *measurement.overrides,
        f"run.threads={threads}", f"run.dir={run}",
    ]  # fmt: skip


def run_dyngs(words: list[str]) -> float:
    """Run a dyngs command. Returns its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "dyngs", *words], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def processor() -> str:
    """Return the model of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    names = [platform.machine()]
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]}, {os.cpu_count()} cores"


def current_commit() -> str:
    """Return the short hash of the checked-out commit."""
    words = ["git", "-C", str(ROOT), "rev-parse", "--short=8", "HEAD"]
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()


def store(name: str, run: Path, cpu_seconds: float, threads: int, commit: str, day: str) -> Path:
    """Write the JSON of a measurement from a finished run and its metrics.json."""
    measurement = MEASUREMENTS[name]
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    stored_mb = None
    if measurement.page in DETAILS:  # the page of systems shows no sizes, and fields have no file
        export = run.parent / f"{run.name}_export"
        if not export.exists():
            run_dyngs(["export", str(run), "--format", "dyngs", "--out", str(export)])
        stored_mb = (export / "scene.dyngs").stat().st_size / 1e6
    keys = {field.name for field in fields(Result)} & metrics.keys()
    values = {key: metrics[key] for key in keys if metrics[key] is not None}
    place = Path(measurement.capture).name
    values |= {
        "command": "dyngs "
        + " ".join(training_command(measurement, place, f"runs/{name}", threads)),
        "capture": measurement.capture,
        "commit": commit,
        "date": day,
        "machine": processor(),
        "threads": threads,
        "steps": metrics["step"],
        "image_size": f"{metrics['width']}x{metrics['height']}",
        "stored_mb": stored_mb,
        "cpu_seconds": cpu_seconds,
        "wall_seconds": metrics["seconds_train"],
    }
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(asdict(Result(**values)), indent=2) + "\n", encoding="utf-8")
    return path


def measure(name: str, captures: Path, runs: Path, threads: int) -> Path:
    """Train and evaluate a measurement, and store it."""
    measurement = MEASUREMENTS[name]
    capture = captures / measurement.capture
    if measurement.estimate_poses:
        posed = runs / f"{name}_capture"
        if not posed.exists():
            run_dyngs(["data", "sfm", str(capture), str(posed)])
        capture = posed
    run = runs / name
    cpu_seconds = run_dyngs(training_command(measurement, str(capture), str(run), threads))
    run_dyngs(["eval", str(run)])
    return store(name, run, cpu_seconds, threads, current_commit(), date.today().isoformat())


def load_results() -> dict[str, Result]:
    """Return all stored results in the order of MEASUREMENTS."""
    paths = {name: RESULTS / f"{name}.json" for name in MEASUREMENTS}
    return {
        name: Result(**json.loads(path.read_text(encoding="utf-8")))
        for name, path in paths.items()
        if path.is_file()
    }


def number(value: float | None, digits: int = 2) -> str:
    """Format a number for a cell; an empty cell for None."""
    return "" if value is None else f"{value:,.{digits}f}"


def psnr_cell(result: Result) -> str:
    """PSNR, on both backgrounds where images have alpha."""
    if result.psnr_white is None or result.psnr_black is None:
        return number(result.psnr)
    return f"{result.psnr_white:.2f} on white, {result.psnr_black:.2f} on black"


def cpu_minutes(result: Result) -> str:
    """CPU minutes of training with one digit."""
    return number(None if result.cpu_seconds is None else result.cpu_seconds / 60, 1)


def table(rows: list[list[str]]) -> str:
    """Format a Markdown table; the first row is its head."""
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)


def detail_cell(result: Result) -> str:
    """The PSNR of what moves, or within the box of a person."""
    if result.psnr_person is not None:
        return number(result.psnr_person)
    return number(result.psnr_moving)


DETAILS = {"static": None, "moving": "PSNR of what moves", "people": "PSNR in the person's box"}


def quality_page(page: str, results: dict[str, Result]) -> str:
    """The page of one kind of scene: figures, commands and origin."""
    chosen = {name: r for name, r in results.items() if MEASUREMENTS[name].page == page}
    detail = DETAILS[page]
    head = ["capture", "PSNR, dB", "SSIM"]
    if detail is not None:
        head.append(detail)
    head += ["Gaussians", "steps", "image", "test views", "CPU minutes"]
    rows = [head]
    for name, result in chosen.items():
        cells = [MEASUREMENTS[name].title, psnr_cell(result), number(result.ssim, 3)]
        if detail is not None:
            cells.append(detail_cell(result))
        views = "" if result.num_views is None else str(result.num_views)
        cells += [number(result.num_gaussians, 0), f"{result.steps:,}", result.image_size, views]
        cells.append(cpu_minutes(result))
        rows.append(cells)
    origin = [["capture", "commit", "date", "threads", "machine", "source"]]
    origin += [
        [MEASUREMENTS[name].title, r.commit, r.date, str(r.threads), r.machine, r.source]
        for name, r in chosen.items()
    ]
    commands = "\n".join(result.command for result in chosen.values())
    return (
        f"# Quality: {page} scenes\n\n"
        "Mean PSNR and SSIM of the whole test split. How to read the figures: "
        "[overview](index.md).\n\n"
        f"{table(rows)}\n\n## Commands\n\n```bash\n{commands}\n```\n\n"
        f"## Origin\n\n{table(origin)}\n"
    )


def size_page(results: dict[str, Result]) -> str:
    """Sizes of models in memory and of their files, and CPU seconds of a step."""
    rows = [["capture", "Gaussians", "float32, MB", "scene.dyngs, MB", "CPU ms per step"]]
    for name, result in results.items():
        if MEASUREMENTS[name].page not in DETAILS:
            continue
        per_step = None if result.cpu_seconds is None else result.cpu_seconds / result.steps * 1000
        rows.append(
            [
                MEASUREMENTS[name].title,
                number(result.num_gaussians, 0),
                number(result.model_mb, 1),
                number(result.stored_mb),
                number(per_step, 0),
            ]
        )
    return (
        "# Sizes and speed\n\n"
        "`float32` is the size of the model in memory. `scene.dyngs` is the file of\n"
        "`dyngs export RUN --format dyngs`. CPU time per step includes pilot runs and reading images.\n\n"
        f"{table(rows)}\n"
    )


def model_overrides(measurement: Measurement) -> list[str]:
    """Return the overrides that change the model, which a reader needs beside the preset."""
    return [word for word in measurement.overrides if word.startswith("model.")]


def readme_table(results: dict[str, Result]) -> str:
    """The table of README.md."""
    rows = [["capture", "preset", "test PSNR, dB", "Gaussians", "file, MB", "CPU minutes"]]
    for name, result in results.items():
        measurement = MEASUREMENTS[name]
        if not measurement.in_readme:
            continue
        psnr = psnr_cell(result)
        if detail_cell(result):
            what = "in the person's box" if result.psnr_person is not None else "what moves"
            psnr += f"; {what} {detail_cell(result)}"
        rows.append(
            [
                measurement.title,
                f"`{' '.join([measurement.preset, *model_overrides(measurement)])}`",
                psnr,
                number(result.num_gaussians, 0),
                number(result.stored_mb),
                cpu_minutes(result),
            ]
        )
    return table(rows)


# Columns of a comparison: key of a row, heading, format
COMPARED = (
    ("psnr", "PSNR, dB", ".2f"),
    ("psnr_moving", "what moves", ".2f"),
    ("psnr_foreground", "foreground", ".2f"),
    ("psnr_worst", "worst frame", ".2f"),
    ("mb", "MB, float32", ".1f"),
    ("fps", "frames/s", ".0f"),
    ("seconds", "training, s", ".0f"),
    ("steps", "steps", ",.0f"),
    ("gaussians", "Gaussians", ",.0f"),
)


def spread_cell(values: Sequence[float | None], form: str) -> str:
    """Format the mean of the values, and half their range if there are several."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    mean = format(fmean(known), form)
    if len(known) == 1:
        return mean
    return f"{mean} ± {format((max(known) - min(known)) / 2, form)}"


def group_rows(
    found: Sequence[Mapping[str, Any]],
) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    """Return the rows of all seeds by capture and variant."""
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in found:
        groups.setdefault((row["capture"], row["variant"]), []).append(row)
    return groups


def comparison_table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of rows of benchmarks/dynamic.py, one per capture and variant."""
    rows = [["capture", "variant", "seeds", *(heading for _, heading, _ in COMPARED)]]
    refused = []
    for (capture, variant), seeds in group_rows(found).items():
        measured = [row for row in seeds if "refused" not in row]
        if measured:
            cells = [spread_cell([row[key] for row in measured], form) for key, _, form in COMPARED]
            rows.append([capture, variant, str(len(measured)), *cells])
        else:
            refused.append(f"\nNot trained: {capture}, {variant}: {seeds[0]['refused']}\n")
    loads = [row["load"] for row in found] or [0.0]
    minutes = sorted({f"{row['minutes']:g}" for row in found})
    return (
        f"{table(rows)}\n\n"
        f"{', '.join(minutes)} minutes of training on one thread; mean over seeds ± half the range.\n"
        "What moves: pixels of motion masks, else of fixed cameras, the same for all variants; empty\n"
        "without both. Fixed cameras were compared with the median of their held-out frames alone;\n"
        "`dyngs eval` now takes all frames and gives other values. Foreground: where images have\n"
        f"alpha. Load of the machine (1 minute average): {min(loads):.1f} to {max(loads):.1f}.\n"
        f"{''.join(refused)}"
    )


# Smallest fraction of a pruned row; controls that are only fine-tuned remove less.
PRUNED_FROM = 0.01
SHOWN_SCORES = ("not pruned", "ours")
# Names of the scores of benchmarks/prune.py as values of `prune.score`
SCORE_NAMES = {
    "spatial": "contribution",
    "both_signed": "variation, signed",
    "both": "variation",
    "ours": "sensitivity",
}


def score_name(row: Mapping[str, Any]) -> str:
    """Return the score of a row of benchmarks/prune.py as a value of ``prune.score``."""
    return SCORE_NAMES.get(row["score"], row["score"])


def pruning_table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of rows of benchmarks/prune.py."""
    rows = [["capture", "score", "removed", "masks", "PSNR, dB", "MB", "stored, MB", "frames/s"]]
    for row in found:
        stored = number(row.get("stored_mb"), 3)
        removed = f"{row['fraction']:.0%}"
        cells = [row["capture"] or "", score_name(row), removed, row["masks"], number(row["psnr"])]
        rows.append([*cells, number(row["mb"]), stored, number(row["fps"], 0)])
    return table(rows)


def pruning_section(found: Sequence[Mapping[str, Any]]) -> str:
    """Return tables of PSNR by score and removed fraction, and of sizes and speeds of one score."""
    fractions = sorted({row["fraction"] for row in found if row["fraction"] >= PRUNED_FROM})
    head = ["capture", "score", "masks", *(f"{fraction:.0%}" for fraction in fractions)]
    lines: dict[tuple[str, str, str], dict[float, float]] = {}
    for row in found:
        if row["fraction"] >= PRUNED_FROM:
            key = (row["capture"], score_name(row), row["masks"])
            lines.setdefault(key, {})[row["fraction"]] = row["psnr"]
    rows = [head]
    for key, values in lines.items():
        rows.append([*key, *(number(values.get(fraction)) for fraction in fractions)])
    shown = [row for row in found if row["masks"] == "none" and row["score"] in SHOWN_SCORES]
    return (
        "PSNR in dB by the fraction that was removed:\n\n"
        f"{table(rows)}\n\nSizes and speeds. *sensitivity, 0%*: nothing removed, but fine-tuned as the others:\n\n"
        f"{pruning_table(shown)}\n"
    )


def mega_table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of rows of benchmarks/mega.py; ratios are to the first part."""
    first: dict[tuple[str, str], float] = {}
    rows = [["capture", "system", "with", "MB", "ratio", "PSNR, dB", "what moves", "Gaussians"]]
    for row in found:
        start = first.setdefault((row["capture"], row["system"]), row["mb"])
        size = [number(row["mb"], 3), number(start / row["mb"], 1)]
        quality = [number(row["psnr"]), number(row["psnr_moving"])]
        names = [row["capture"], row["system"], row["part"]]
        rows.append([*names, *size, *quality, number(row["gaussians"], 0)])
    return table(rows)


# Comparisons of docs/results.md whose tables show all keys of their rows but these: title, text
COMPARISONS = {
    "people": (
        "People from a few images",
        "Networks trained on synthetic people (`dyngs data synth people`), one thread, PSNR in the\n"
        "box of the person on white (`benchmarks/compare_people.py`).",
    ),
    "scales": (
        "Scales of images",
        "Trained at one scale (1x), tested at several (`benchmarks/scales.py`); PSNR in dB.",
    ),
    "fields": (
        "Radiance fields at 400 px",
        "How far one thread of a CPU gets. A view takes 12 s (`ngp`) or over a minute (`nerf`).",
    ),
    "triangles": (
        "Triangles and Gaussians",
        "At most six minutes, or the steps of the preset, with about as many learned numbers; one\n"
        "thread (`benchmarks/triangles.py`).",
    ),
}
HIDDEN = ("commit", "command")
MOVING_ID = "moving-scenes-at-equal-minutes"
SOURCES = {"code": "", "paper": "", "second": " (second hand)", "unverified": " (unverified)"}


@dataclass(frozen=True)
class OwnFigure:
    """A stored figure of a system."""

    figure: str
    protocol: str
    commit: str
    command: str


def plain_table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table of rows with the same keys, without ``HIDDEN``."""
    head = [key for key in found[0] if key not in HIDDEN]
    rows = [head]
    for row in found:
        values = [row.get(key) for key in head]
        rows.append([number(v) if v is None or isinstance(v, float) else str(v) for v in values])
    return table(rows)


def load_rows(path: Path) -> list[dict[str, Any]]:
    """Return the stored rows of a comparison; none if there is no file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []


def chosen_rows(system: Mapping[str, Any]) -> list[OwnFigure]:
    """Return the figures of the rows that ``rows`` of a system selects: by file, key and value."""
    found = []
    for name, wanted in system.get("rows", {}).items():
        for row in load_rows(RESULTS / f"comparisons/{name}.json"):
            if all(row[key] == value for key, value in wanted.items()):
                figure = f"{row['capture']} {row['psnr']:.2f}"
                if "mb" in row:
                    figure += f", {row.get('stored_mb', row['mb']):.2f} MB"
                title = COMPARISONS[name][0] if name in COMPARISONS else name
                protocol = f"[tables](#{title.lower().replace(' ', '-')})"
                command = row.get("command", system.get("command"))
                found.append(OwnFigure(figure, protocol, row["commit"], command))
    return found


def own_figures(
    system: Mapping[str, Any], results: Mapping[str, Result], moving: Sequence[Mapping[str, Any]]
) -> list[OwnFigure]:
    """Return the figures of a system from its measurements and the comparison ``moving``."""
    found = []
    for name in system.get("measurements", ()):
        if name in results:
            result = results[name]
            figure = f"{Path(result.capture).name} {psnr_cell(result)}"
            protocol = f"{result.image_size}, {result.steps:,} steps"
            found.append(OwnFigure(figure, protocol, result.commit, result.command))
    measured_rows = [row for row in moving if "refused" not in row]
    stored = {row["variant"] for row in measured_rows}
    # The first variant that is stored
    wanted = next((name for name in system.get("variants", ()) if name in stored), None)
    of_variant = {
        capture: seeds
        for (capture, variant), seeds in group_rows(measured_rows).items()
        if variant == wanted
    }
    if of_variant:
        figures = [
            f"{capture} {spread_cell([row['psnr'] for row in seeds], '.2f')}"
            for capture, seeds in of_variant.items()
        ]
        first = next(iter(of_variant.values()))[0]
        protocol = f"{first['minutes']:g} minutes, one thread ([all](#{MOVING_ID}))"
        found.append(OwnFigure("; ".join(figures), protocol, first["commit"], first["command"]))
    return found + chosen_rows(system)


def unmeasured_commands(system: Mapping[str, Any]) -> list[str]:
    """Return the commands that train a system without stored figures."""
    commands = []
    for name in system.get("measurements", ()):
        measurement = MEASUREMENTS[name]
        place = Path(measurement.capture).name
        words = training_command(measurement, place, f"runs/{name}", threads=1)
        commands.append(" ".join(["dyngs", *words]))
    return commands + ([system["command"]] if "command" in system else [])


def systems_page(results: Mapping[str, Result], moving: Sequence[Mapping[str, Any]]) -> str:
    """The page with a row per system: published figure, own figure, command and commit."""
    systems = yaml.safe_load(PUBLISHED.read_text(encoding="utf-8"))
    head = ["system", "published", "data, protocol", "ours, PSNR in dB", "protocol", "differs"]
    rows = [[*head, "commit"]]
    commands = []
    for system in systems:
        title = f"{system['system']} ({system['paper']})"
        if "arxiv" in system:
            link = f"https://arxiv.org/abs/{system['arxiv']}"
            title = f"[{system['system']}]({link}), {system['paper']}"
        own = own_figures(system, results, moving)
        rows.append(
            [
                title,
                system["published"] + SOURCES[system["checked"]],
                system["protocol"],
                "; ".join(x.figure for x in own) or "not measured",
                "; ".join(dict.fromkeys(x.protocol for x in own)),
                system["differs"],
                ", ".join(dict.fromkeys(x.commit for x in own)),
            ]
        )
        commands.append(f"# {system['system']}")
        commands += dict.fromkeys(x.command for x in own) or unmeasured_commands(system)
    text = (
        "# Results beside published figures\n\n"
        "Every system that dyngs trains, with the figure of its paper and ours. The data sets of the\n"
        "papers are not always the same, so most rows do not compare directly: see *differs*.\n"
        "*Second hand*: read in another paper or note. *Unverified*: not confirmed.\n"
        "Captures: [benchmarks](benchmarks/index.md#captures).\n\n"
        f"{table(rows)}\n\n## Commands\n\n"
        "`dyngs eval RUN` then prints the figure. Networks for people first\n"
        "[predict a person](guides/people.md#predict-from-a-few-images).\n\n"
        "```bash\n" + "\n".join(commands) + "\n```\n"
    )
    if moving:
        text += (
            "\n## Moving scenes at equal minutes\n\n"
            "Variants are values of `model.deform.kind` in the preset `dynamic`, and the preset `4dgs`.\n"
            "*all*: `model.select_moving=false`; *selected*: true. *attached*:\n"
            "`model.deform.position_gradient=true`; *detached*: false.\n\n"
            f"{comparison_table(moving)}"
        )
    pruning = load_rows(PRUNING)
    if pruning:
        text += (
            "\n## Pruning\n\n4D Gaussians pruned and fine-tuned for 500 steps. Scores and masks:\n"
            "[motion](concepts/motion.md#pruning-over-time). Frames/s at 400x400 on two threads, timed\n"
            f"alternately on a busy machine.\n\n{pruning_section(pruning)}"
        )
    parts = load_rows(MEGA)
    if parts:
        text += (
            "\n## MEGA\n\nEach part is added to those before, at equal steps; the last run is stored as\n"
            f"files. Parts: [motion](concepts/motion.md#compact-models-mega).\n\n{mega_table(parts)}\n"
        )
    for name, (title, note) in COMPARISONS.items():
        found = load_rows(RESULTS / f"comparisons/{name}.json")
        if found:
            text += f"\n## {title}\n\n{note}\n\n{plain_table(found)}\n"
    return text


def written_pages(results: dict[str, Result]) -> dict[Path, str]:
    """Return the contents of all pages, and of README.md with its new table."""
    pages = {PAGES / f"{page}.md": quality_page(page, results) for page in DETAILS}
    pages[PAGES / "size.md"] = size_page(results)
    pages[ROOT / "docs/results.md"] = systems_page(results, load_rows(MOVING))
    readme = ROOT / "README.md"
    before, rest = readme.read_text(encoding="utf-8").split(TABLE_BEGIN)
    after = rest.split(TABLE_END)[1]
    table_text = f"{TABLE_BEGIN}\n{readme_table(results)}\n{TABLE_END}"
    return pages | {readme: before + table_text + after}


def main() -> None:
    """Run one command of the script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="print the names of all measurements")
    run = commands.add_parser("run", help="measure and store")
    run.add_argument("name", choices=MEASUREMENTS)
    run.add_argument("--captures", type=Path, required=True)
    run.add_argument("--runs", type=Path, default=Path("runs"))
    run.add_argument("--threads", type=int, default=1)
    commands.add_parser("write", help="write docs/benchmarks and the table of README.md")
    options = parser.parse_args()
    if options.command == "list":
        for name, measurement in MEASUREMENTS.items():
            print(f"{name}: {' '.join(training_command(measurement, 'CAPTURE', 'RUN', 1))}")
    elif options.command == "run":
        print(measure(options.name, options.captures, options.runs, options.threads))
    else:
        for path, text in written_pages(load_results()).items():
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
