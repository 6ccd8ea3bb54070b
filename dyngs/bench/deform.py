"""Benchmark of a deformation field in training, with and without the split into moving and static Gaussians."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from dyngs.config import Config, DeformField, DynamicModel
from dyngs.config.io import load_config
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import new_field
from dyngs.deform.scene import DynamicScene
from dyngs.errors import DyngsError
from dyngs.files.write import write_text
from dyngs.kinds import GaussianTrainer, assemble
from dyngs.ops.native import active_isa, kernel_threads
from dyngs.runs.checkpoint import latest_checkpoint, load_run

VARIANTS = ("no field", "moving Gaussians", "all Gaussians")
"""What the field deforms: nothing, the moving Gaussians, or all of them (no static split)."""
STEPS_PER_ROUND = 5
FIELD_STAGES = ("field forward", "field backward", "field penalties", "field Adam")


@dataclass(frozen=True)
class DeformLoad:
    """A configuration to measure, and the fraction of its Gaussians that move.

    Attributes:
        run_dir: run whose checkpoint to start from; None: untrained Gaussians.
        moving_fraction: fraction of moving Gaussians without a run.
    """

    config: Config
    run_dir: Path | None = None
    moving_fraction: float = 0.1


@dataclass(frozen=True)
class DeformReport:
    """Median times in milliseconds.

    Attributes:
        steps: time of a training step by variant, interleaved.
        stages: time by stage of the field, for the moving Gaussians.
        field_fraction: fraction of the field in a step with the moving Gaussians.
    """

    isa: str
    threads: int
    kind: str
    num_gaussians: int
    num_moving: int
    steps: dict[str, float]
    stages: dict[str, float]

    @property
    def field_fraction(self) -> float:
        moving, still = self.steps[VARIANTS[1]], self.steps[VARIANTS[0]]
        return max(0.0, 1 - still / moving)


def load_of_run(run_dir: Path) -> DeformLoad:
    """Return the load of a trained dynamic run. Raises DyngsError if it has no field."""
    run = load_run(run_dir)
    if not run.config.model.may_move or run.scene.is_static:
        raise DyngsError(f"{run_dir}: nothing moves in this run; give one of a dynamic model, or none")
    return DeformLoad(run.config, run_dir)


def synthetic_load(folder: Path, num_gaussians: int, moving_fraction: float, kind: str) -> DeformLoad:
    """Return a load without a run: random Gaussians and a small room, which is written into ``folder``."""
    keys = {
        "data.root": folder,
        "model.kind": "dynamic",
        "model.deform.kind": kind,
        "init.kind": "random",
        "init.num_random": num_gaussians,
    }
    config = load_config(None, [f"{key}={value}" for key, value in keys.items()])
    write_dynamic_capture("room", folder, DynamicOptions(size=200, num_times=4, num_cameras=3, samples=1))
    return DeformLoad(config, None, moving_fraction)


def bench_deform(load: DeformLoad, threads: int, rounds: int) -> DeformReport:
    """Measure step times of the three variants, interleaved so that other load affects them alike."""
    with kernel_threads(threads):
        trainers = {name: _trainer(load, name) for name in VARIANTS}
        samples: dict[str, list[float]] = {name: [] for name in VARIANTS}
        for number in range(rounds + 1):
            for name, trainer in trainers.items():
                for _ in range(STEPS_PER_ROUND):
                    seconds = _seconds(trainer.step)
                    if number:  # warm-up
                        samples[name].append(seconds)
        trainer = trainers[VARIANTS[1]]
        num_gaussians = trainer.num_gaussians
        return DeformReport(
            isa=active_isa(),
            threads=threads,
            kind=_field(load.config).kind,
            num_gaussians=num_gaussians,
            num_moving=trainer.num_moving,
            steps={name: 1e3 * statistics.median(samples[name]) for name in VARIANTS},
            stages=_field_stages(trainer, rounds),
        )


def format_report(report: DeformReport) -> str:
    """Return the report as text."""
    fraction = report.num_moving / max(report.num_gaussians, 1)
    lines = [
        f"{report.kind}: {report.num_gaussians:,} Gaussians, {report.num_moving:,} ({fraction:.1%}) move; "
        f"{report.threads} thread(s), instruction set {report.isa}",
        f"{'training step':<24}{'median ms':>10}{'steps/s':>10}",
    ]
    lines += [f"{name:<24}{ms:10.2f}{1e3 / ms:10.1f}" for name, ms in report.steps.items()]
    lines += [f"{name:<24}{ms:10.2f}" for name, ms in report.stages.items()]
    faster = report.steps[VARIANTS[2]] / report.steps[VARIANTS[1]]
    lines.append(
        f"the field takes {report.field_fraction:.0%} of a step; the static split makes steps {faster:.2f}x faster"
    )
    return "\n".join(lines)


def write_report(report: DeformReport, path: Path) -> None:
    """Write the report as JSON."""
    write_text(path, json.dumps(asdict(report) | {"field_fraction": report.field_fraction}, indent=2) + "\n")


def _field(config: Config) -> DeformField:
    if not isinstance(config.model, DynamicModel):
        raise DyngsError("bench deform needs model.kind=dynamic")
    return config.model.deform


def _trainer(load: DeformLoad, variant: str) -> GaussianTrainer:
    """Return a trainer after the last step of its schedules, in which the Gaussians of the variant move."""
    trainer = assemble(load.config)
    if load.run_dir is not None:
        trainer.restore(latest_checkpoint(load.run_dir))
    trainer.done = load.config.train.steps
    scene = _dynamic(trainer)
    device = scene.gaussians.means.device
    if variant == VARIANTS[0]:
        trainer.model.exchange(replace(scene, field=None, moving=scene.moving[:0]))
    elif variant == VARIANTS[2] or load.run_dir is None:
        fraction = 1.0 if variant == VARIANTS[2] else load.moving_fraction
        rows = torch.arange(round(fraction * len(scene)), device=device)
        low, high = torch.zeros(3, device=device), torch.ones(3, device=device)
        setup = FieldSetup(low, high, len(scene.times), len(rows), trainer.extent)
        field = new_field(_field(load.config), setup, torch.Generator("cpu").manual_seed(0))
        trainer.model.exchange(replace(scene, field=field, moving=rows))
    return trainer


def _dynamic(trainer: GaussianTrainer) -> DynamicScene:
    match trainer.model.scene:
        case DynamicScene():
            return trainer.model.scene
        case _:
            raise DyngsError(f"{trainer.config.data.root}: a capture without times; nothing can move in it")


def _field_stages(trainer: GaussianTrainer, rounds: int) -> dict[str, float]:
    """Measure the stages of the field, in milliseconds."""
    scene = _dynamic(trainer)
    field = scene.field
    if field is None:
        return dict.fromkeys(FIELD_STAGES, 0.0)
    means = scene.gaussians.means.detach()[scene.moving]
    samples: dict[str, list[float]] = {name: [] for name in FIELD_STAGES}
    for number in range(rounds + 1):
        start = time.perf_counter()
        offsets = field.offsets(means, 0.37)
        outputs = [x for x in vars(offsets).values() if x is not None]
        forward = time.perf_counter() - start
        backward = _seconds(lambda o=outputs: torch.autograd.backward(o, [torch.ones_like(x) for x in o]))
        penalty = _seconds(lambda: [p.backward() for p in field.penalties(0.37).values()])
        adam = _seconds(lambda: field.parameters.step(10**6, 1.0))
        if number:
            for name, seconds in zip(FIELD_STAGES, (forward, backward, penalty, adam), strict=True):
                samples[name].append(seconds)
    return {name: 1e3 * statistics.median(values) for name, values in samples.items()}


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
