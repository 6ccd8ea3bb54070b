"""The training loop around ``Trainer.step``: run folder, checkpoints, logs, interruptions."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.budget.count import CountLimit, count_limit_of
from dyngs.budget.limits import require_possible
from dyngs.budget.size import has_file, write_within
from dyngs.budget.speed import SpeedLimit
from dyngs.budget.time import Deadline, deadline_of, first_fit, refitted, with_steps
from dyngs.build import assemble
from dyngs.config import Config, HumanPredictorModel
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.errors import DyngsError
from dyngs.evaluate.metrics import psnr
from dyngs.ops.memory import keep_freed_memory
from dyngs.ops.native import kernel_threads
from dyngs.prune.stage import compact_
from dyngs.runs.checkpoint import (
    Checkpoint,
    checkpoint_paths,
    last_good,
    latest_checkpoint,
    remove_old_checkpoints,
    save_checkpoint,
    seconds_at,
    step_of,
)
from dyngs.runs.folder import begin, default_folder, require_startable, tidy, was_only_begun
from dyngs.runs.lock import writing
from dyngs.runs.log import LogRecord, Progress, RunLog
from dyngs.train.interrupt import Interrupts
from dyngs.train.predictor import NetworkTrainer, assemble_network
from dyngs.train.step import StepReport, Trainer

COUNT, SPEED = "budget.count", "budget.speed"
"""Parts of a checkpoint: what was done for limits."""


def train(config: Config, *, resume_from: Path | None = None) -> Path:
    """The run folder of a finished training.

    Args:
        config: everything that decides the run; on resuming, that of the run folder.
        resume_from: a run folder to go on with, from its newest checkpoint, or from the beginning where it was stopped
            before its first: the result has the same bytes as if the run had never stopped.

    Raises:
        DyngsError: bad input, a run folder that already holds a run or that another process writes into, a budget that
            cannot be kept, a loss that is not finite, a full disk.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once a checkpoint is saved; the message says how to go on.
    """
    run_dir = resume_from or config.run.dir or default_folder(config.run.name)
    require_possible(config)
    if resume_from is not None and (not run_dir.is_dir() or _is_done_and_read_only(config, run_dir)):
        latest_checkpoint(run_dir)
        return run_dir
    keep_freed_memory()
    with writing(run_dir) as is_sole_writer, kernel_threads(config.run.threads or num_cores()):
        tidy(run_dir, sole_writer=is_sole_writer)
        return _train(config, run_dir, resume_from)


def _is_done_and_read_only(config: Config, run_dir: Path) -> bool:
    """Nothing is to be done in the run folder, and nothing can be."""
    paths = checkpoint_paths(run_dir)
    is_done = bool(paths) and step_of(paths[-1]) >= config.total_steps and not _owes_file(config, run_dir)
    return is_done and not os.access(run_dir, os.W_OK)


def _train(config: Config, run_dir: Path, resume_from: Path | None) -> Path:
    watch = _Stopwatch()
    resumed = _start_of_run(config, run_dir, resuming=resume_from is not None)
    if resumed is not None and resumed.info.step >= config.total_steps and not _owes_file(config, run_dir):
        return run_dir
    trainer, wanted, preparing = _assembled(config, restored=resumed is not None), None, 0.0
    if resumed is not None:
        trainer.restore(resumed)
        watch.pause(-seconds_at(run_dir, resumed.info.step))
    speed = _speed_of(config, trainer, resumed)
    if resumed is None:
        if config.budget.max_minutes is not None and isinstance(trainer, Trainer):
            wanted = config.train.steps
            config = first_fit(config, trainer, watch.seconds + (speed.reserve() if speed else 0.0))
            preparing = -watch.seconds
            trainer = refitted(trainer, config)
            preparing += watch.seconds
        begin(run_dir, config)
    with (
        RunLog(run_dir, trainer.done, tensorboard=config.train.tensorboard) as log,
        Progress(config.total_steps, trainer.done) as progress,
        Interrupts() as interrupts,
    ):
        deadline = deadline_of(config, wanted, preparing)
        loop = _Loop(config, run_dir, trainer, log, progress, watch, deadline, speed)
        if isinstance(trainer, Trainer):
            loop.count = count_limit_of(trainer, resumed.part(COUNT) if resumed is not None else {})
        loop.run(interrupts)
    if isinstance(loop.trainer, Trainer):
        _keep_budget(loop, loop.trainer)
    return run_dir


def _assembled(config: Config, *, restored: bool) -> Trainer | NetworkTrainer:
    if isinstance(config.model, HumanPredictorModel):
        return assemble_network(config)
    return assemble(config, restored=restored)


def _speed_of(config: Config, trainer: Trainer | NetworkTrainer, resumed: Checkpoint | None) -> SpeedLimit | None:
    """The speed that a run owes, as it was in a checkpoint or as it is possible; None: none."""
    if config.budget.min_fps is None or not isinstance(trainer, Trainer):
        return None
    speed = SpeedLimit(config.budget.min_fps)
    speed.begin(trainer, resumed.part(SPEED) if resumed is not None else {})
    return speed


def _owes_file(config: Config, run_dir: Path) -> bool:
    return config.budget.max_mb is not None and not has_file(run_dir)


def _keep_budget(loop: _Loop, trainer: Trainer) -> None:
    """What a finished run still owes to its budget, and a line for each limit."""
    budget = trainer.config.budget
    if loop.count is not None:
        print(loop.count.reached(trainer), flush=True)
    if loop.deadline is not None:
        print(loop.deadline.kept(trainer.done, loop.watch.seconds), flush=True)
    if budget.max_mb is not None:
        print(write_within(trainer, loop.run_dir, budget.max_mb), flush=True)
    if loop.speed is not None:
        print(loop.speed.reached(trainer), flush=True)


class _Stopwatch:
    """Training time: from reading the capture on, over all resumes, without evaluations."""

    def __init__(self) -> None:
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._since

    def pause(self, seconds: float) -> None:
        """Leave ``seconds`` out (negative: count them in)."""
        self._since += seconds


@dataclass
class _Loop:
    config: Config
    run_dir: Path
    trainer: Trainer | NetworkTrainer
    log: RunLog
    progress: Progress
    watch: _Stopwatch
    deadline: Deadline | None
    speed: SpeedLimit | None = None
    count: CountLimit | None = None

    def run(self, interrupts: Interrupts) -> None:
        """Step until the end, or until interrupted."""
        options, saved = self.config.train, self.trainer.done
        while self.trainer.done < self.config.total_steps and not interrupts.requested:
            try:
                if self.trainer.done == self.config.train.steps and isinstance(self.trainer, Trainer):
                    self.progress.say(str(compact_(self.trainer)))
                report = self.trainer.step()
            except DyngsError as error:
                raise DyngsError(f"{error}. {last_good(self.run_dir)}") from error
            step = report.step
            if report.finding is not None:
                print(f"step {step}: {report.finding}", flush=True)
            if self.deadline is not None:
                self._keep_time(self.deadline)
            self._remove()
            total = self.config.total_steps
            if step % options.log_every == 0 or step == total:
                self._tell(report)
            evaluates = options.eval_every > 0 and step % options.eval_every == 0
            is_last = step in (self.config.train.steps, total)
            if evaluates or is_last or (options.save_every > 0 and step % options.save_every == 0):
                saved = self._save()
            if evaluates:
                self._evaluate(step)
        if interrupts.requested and self.trainer.done < self.config.total_steps:
            if self.trainer.done > saved:
                self._save()
            raise KeyboardInterrupt(
                f"stopped after step {self.trainer.done}; go on with: dyngs train --resume {self.run_dir}"
            )

    def _keep_time(self, deadline: Deadline) -> None:
        """Go on with as many steps as fit into the time; none where it is over."""
        done, steps = self.trainer.done, self.config.train.steps
        found = deadline.steps(self.config, done, self.watch.seconds)
        if found == steps or not isinstance(self.trainer, Trainer):
            return
        self.config = with_steps(self.config, found)
        self.progress.expect(self.config.total_steps)
        if found > done:
            start = self.watch.seconds
            self.trainer = refitted(self.trainer, self.config)
            if self.speed is not None:
                self.speed.hold(self.trainer)
            prepared = self.watch.seconds
            self._save()  # a resumed run goes on from here with the new schedules
            now = self.watch.seconds
            deadline.refit_seconds, deadline.save_seconds = prepared - start, now - prepared
            deadline.begin(done, now)
        else:
            self.trainer.config = with_steps(self.trainer.config, done)
        save_config(self.config, self.run_dir / RESOLVED_NAME)

    def _remove(self) -> None:
        """Remove Gaussians where there are too many of them, or drawing is measured to be too slow."""
        if not isinstance(self.trainer, Trainer):
            return
        used, given = self.watch.seconds, self.deadline.seconds if self.deadline is not None else math.inf
        said = [self.count.after_step(self.trainer, used / given)] if self.count is not None else []
        if self.speed is not None:
            said.append(self.speed.after_step(self.trainer, used, given))
            if self.deadline is not None:
                self.deadline.reserve = self.speed.reserve()
        for line in said:
            if line is not None:
                self.progress.say(line)

    def _tell(self, report: StepReport) -> None:
        quality = psnr(report.rendered, report.truth, report.picture.mask)
        num_gaussians, num_moving = _counts(self.trainer)
        record = LogRecord(
            step=report.step,
            loss=report.loss,
            psnr=quality if math.isfinite(quality) else None,
            num_gaussians=num_gaussians,
            num_moving=num_moving,
            bad_gradients=self.trainer.bad_gradients,
            seconds=round(self.watch.seconds, 3),
        )
        self.log.write(record)
        self.progress.update(record)

    def _save(self) -> int:
        checkpoint = self.trainer.checkpoint()
        for part, limit in ((COUNT, self.count), (SPEED, self.speed)):
            if limit is not None:
                kept = {f"{part}.{name}": x for name, x in limit.state().items()}
                checkpoint = replace(checkpoint, tensors=checkpoint.tensors | kept)
        save_checkpoint(self.run_dir, checkpoint, self.watch.seconds)
        return self.trainer.done

    def _evaluate(self, step: int) -> None:
        """Scores of the test split into the log, where there is one."""
        from dyngs.evaluate.report import evaluate_run

        if not self.trainer.has_test_views:
            return
        start = time.perf_counter()
        report = evaluate_run(self.run_dir, "test")
        self.log.write_scores(step, "test", report.psnr, report.ssim)
        self.watch.pause(time.perf_counter() - start)
        self.progress.pause(time.perf_counter() - start)


def _counts(trainer: Trainer | NetworkTrainer) -> tuple[int, int]:
    """Gaussians there are, and those of them that depend on time or pose."""
    if isinstance(trainer, NetworkTrainer):
        return trainer.num_gaussians, trainer.num_gaussians
    count = len(trainer.optimizer.parameters)
    return count, trainer.model.num_moving(count)


def _start_of_run(config: Config, run_dir: Path, *, resuming: bool) -> Checkpoint | None:
    """The checkpoint to go on from, or None for a run that begins: a new one, or one stopped before its first.

    Raises:
        DyngsError: resuming where no run was begun, or a new run where something is that it would replace.
    """
    if not resuming:
        require_startable(run_dir, config)
        return None
    if was_only_begun(run_dir):
        return None
    checkpoint = latest_checkpoint(run_dir)
    remove_old_checkpoints(run_dir)
    return checkpoint


def num_cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
