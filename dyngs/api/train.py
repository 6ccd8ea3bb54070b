"""Train a run: its folder, its checkpoints and log, its limits, and the loop between them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from dyngs.api.budget.count import CountLimit
from dyngs.api.budget.size import has_file, write_limited_file
from dyngs.api.budget.time import TimeLimit, fit_minutes
from dyngs.api.choose import write_choice
from dyngs.api.following import Leader
from dyngs.api.run_choice import choose_run
from dyngs.api.stages import (
    continue_scene,
    extend_run,
    find_first_gaussians,
    find_poses,
    read_same_capture,
    run_pilots,
    set_limits,
    share_views,
)
from dyngs.compress.clean import remove_floaters
from dyngs.compress.stage import prune_stage
from dyngs.config import Config
from dyngs.config.io import RESOLVED_NAME
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info, log_warning, quote_path
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.scene_space import normalise_capture
from dyngs.evaluate.report import evaluate_run, held_out_psnr
from dyngs.io.outputs import lock_folder
from dyngs.io.write import to_uint8
from dyngs.models.kind import HasBody, PredictsScenes, capability
from dyngs.models.views import background_colour
from dyngs.ops.device import deterministic, keep_freed_memory, select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.capture_record import write_record
from dyngs.runs.checkpoint import (
    Checkpoint,
    describe_last_checkpoint,
    latest_checkpoint,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.folder import (
    LOG_NAME,
    collect_inputs,
    default_run_dir,
    is_finished,
    load_begun_config,
    load_requested_config,
    remove_partial_files,
    require_startable,
    update_data_root,
    write_config,
    write_requested_config,
)
from dyngs.training.clock import SaveTimer, Stopwatch
from dyngs.training.events import (
    Evaluated,
    Event,
    Listener,
    Message,
    ProgressImage,
    Saved,
    StepDone,
    TotalChanged,
)
from dyngs.training.limits import validate_limits
from dyngs.training.loggers import open_loggers, require_loggers
from dyngs.training.loop import Editor, Interrupts, Loop, Trainable
from dyngs.training.losses import AddedLoss, require_losses
from dyngs.training.memory import memory_forecasts
from dyngs.training.new_trainer import build_trainer
from dyngs.training.plan import RunPlan
from dyngs.training.prediction import network_trainer
from dyngs.training.processes import Processes
from dyngs.training.run_log import RunLog
from dyngs.training.trainer import Trainer

PICTURES = "pictures"  # folder of the pictures of a person
# Largest part of the training time, and seconds, that the PSNR of test views may take
_EVAL_FRACTION = 0.02
_EVAL_SECONDS = 10.0


def train(
    config: Config,
    *,
    resume_from: Path | None = None,
    listeners: Sequence[Listener] = (),
    processes: Processes | None = None,
    progress: Callable[[], AbstractContextManager[ProgressCallback]] = lambda: nullcontext(
        ignore_progress
    ),
    capture: Capture | None = None,
    losses: Sequence[AddedLoss] = (),
) -> Path:
    """Train and return the run folder. ``dyngs.train`` is the same for users.

    Poses of photos and videos are found first, and a body is fitted to a person where that is
    needed.

    Example:

        from dyngs.api.train import train
        from dyngs.config.io import load_config

        overrides = ["data.root=lego", "run.dir=runs/short", "train.steps=2", "init.num_random=50"]
        run = train(load_config("static", overrides))

    Args:
        config: everything that decides the run; on resuming, that of the run folder, whose
            ``train.steps`` may be changed: the run then goes on to so many, on their schedules
            (``dyngs.training.plan``).
        resume_from: a run folder to go on with, from its newest checkpoint, or from the beginning
            where it was stopped before its first: the result has the same bytes as if the run had
            never stopped.
        listeners: are told everything that happens, see ``dyngs.training.events``.
        processes: that this one, the first of them, leads; None: it is alone.
        progress: shows how far what comes before training is.
        capture: trained on instead of what ``config.data`` reads.
        losses: added to those of dyngs, named in ``config.train.losses``.

    Raises:
        DyngsError: bad input, a run folder that already holds a run or that another process writes
            into, a budget that cannot be kept, no GPU where one is asked for, a loss that is not
            finite, a full disk.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once a checkpoint is saved; the message says how
            to go on.
    """
    folder = resume_from or config.run.dir or default_run_dir(config)
    processes = processes or Processes()
    require_losses(config, losses)
    found = None if capture is None else normalise_capture(capture)
    plan = RunPlan(config, config, capture=found, losses=tuple(losses))
    plan = share_views(plan, processes)
    validate_limits(plan.resolved)
    require_loggers(plan.resolved)
    device = select_device(config.run.device)
    if resume_from is None:
        if not (folder / RESOLVED_NAME).is_file():
            collect_inputs(config).require_output(folder)
        with progress() as report:
            plan = continue_scene(find_poses(plan, report))
        if config.run.dir is None:
            folder, continued = choose_run(folder, plan.resolved, continues=capture is None)
            if continued is not None:
                resume_from = folder
                plan = replace(plan, requested=continued, resolved=continued)
    elif not folder.is_dir():
        latest_checkpoint(folder)  # raises, and says what is there
    keep_freed_memory()
    bytewise = deterministic(device, config.run.deterministic)
    with lock_folder(folder) as alone, kernel_threads(_num_threads(config, processes)), bytewise:
        remove_partial_files(folder, sole_writer=alone)
        resumed = None
        if resume_from is None:
            plan = replace(plan, requested=plan.resolved)
            is_done = is_finished(folder, plan.resolved)
        else:
            update_data_root(folder, plan.resolved.data)
            if load_begun_config(folder) is None:  # else stopped before its first checkpoint
                resumed = latest_checkpoint(folder)
            plan = replace(plan, requested=load_requested_config(folder))
            plan = extend_run(plan, folder, resumed)
            is_done = resumed is not None and resumed.info.step >= plan.resolved.total_steps
        has_export = plan.resolved.budget.max_mb is None or has_file(folder)
        if is_done and has_export:
            advice = f"`dyngs train --resume {quote_path(folder)} train.steps=N` trains longer"
            if plan.resolved.prune.is_enabled:
                advice = "give another run.dir to train again"
            steps = format_count(plan.resolved.total_steps, "step")
            log_info(f"{folder}: run already finished ({steps}); {advice}")
            return folder
        if resume_from is None:
            require_startable(folder, plan.resolved)
        stopwatch = Stopwatch()
        images = None
        if resumed is None:
            with progress() as report:
                plan = run_pilots(plan, report)
            plan = set_limits(find_first_gaussians(plan))
            if plan.seconds is not None:
                plan, message, images = fit_minutes(plan, stopwatch, _built)
                if message:
                    log_info(message)
        else:
            resumed.require_settings(plan.resolved)
            plan = set_limits(read_same_capture(plan, folder, resumed))
            stopwatch.exclude(-seconds_at(folder, resumed.info.step))
        trainer = _built(plan, resumed, images)
        run = _Run(plan, trainer, folder, resumed, processes=processes, stopwatch=stopwatch)
        run.run(listeners)
    return run.folder


def _built(
    plan: RunPlan, resumed: Checkpoint | None = None, images: ImageLoader | None = None
) -> Any:
    """Return the trainer of a plan, before its first step or where it was ``resumed``."""
    config = plan.resolved
    trainer: Any
    if capability(config.model, PredictsScenes):
        trainer = network_trainer(config)
    else:
        trainer = build_trainer(
            config,
            plan.capture,
            restored=resumed is not None,
            first=plan.first,
            uncapped=plan.uncapped,
            images=images,
            added_losses=plan.losses,
        )
    if resumed is not None:
        trainer.restore(resumed)
    return trainer


class _Run:
    """The loop of a run with its folder: checkpoints, log, evaluations and limits.

    Args:
        watch: seconds since the capture was read, those of pilot runs included.
    """

    def __init__(
        self,
        plan: RunPlan,
        trainer: Trainable,
        folder: Path,
        resumed: Checkpoint | None,
        *,
        processes: Processes,
        stopwatch: Stopwatch,
    ) -> None:
        config = plan.resolved
        self._plan = plan
        self._processes = processes
        self.folder = folder
        self._has_test_views = plan.capture is not None and bool(plan.capture.splits.get("test"))
        self._count = None
        self._time = None
        editors: list[Editor] = []
        if isinstance(trainer, Trainer):
            editors = [remove_floaters]
            if plan.seconds is not None:
                corrects = resumed is None or plan.is_extended
                steps = plan.requested.train.steps
                self._time = TimeLimit(plan.seconds, steps, corrects=corrects)
                editors.append(self._time)
            if plan.max_gaussians is not None:
                self._count = CountLimit(plan.max_gaussians, plan.seconds)
                editors.append(self._count)
            if trainer.num_gaussians:
                for forecast in memory_forecasts(trainer, processes.local_size):
                    log_info(str(forecast))
                    warning = forecast.warning()
                    if warning is not None:
                        log_warning(warning)
        self._leader = Leader(processes, config, _num_threads(config, processes))
        self.loop = Loop(
            trainer,
            config.total_steps,
            stopwatch,
            lambda: describe_last_checkpoint(self.folder),
            stages=[prune_stage] if isinstance(trainer, Trainer) else [],
            limits=editors,
            before_step=self._leader.before_step,
        )
        self._saved = trainer.done
        self._save_timer = SaveTimer(config.train.save_minutes, stopwatch.seconds)
        self._body_kind = capability(config.model, HasBody)
        if resumed is None:
            if self._body_kind is not None:
                self._body_kind.copy_pictures(config.data, self.folder / PICTURES)
            write_config(config, self.folder)
            write_requested_config(self.folder, plan.requested)
            write_record(self.folder, config.data, plan.capture)
            write_choice(self.folder, plan.choice)

    @property
    def config(self) -> Config:
        """The config as saved; a limit on the time may change the number of steps."""
        return self.loop.trainer.config

    def run(self, listeners: Sequence[Listener]) -> None:
        """Step until the end, or until interrupted, and report the limits."""
        options = self.config.train
        loop = self.loop
        done = loop.trainer.done
        with (
            RunLog(
                self.folder / LOG_NAME,
                done,
                every=options.log_every,
                loggers=open_loggers(self.config, self.folder, done),
            ) as log,
            Interrupts() as interrupts,
        ):
            loop.subscribe(self._leader, log, *listeners, self._save_and_evaluate)
            try:
                loop.run(lambda: interrupts.requested or self._processes.is_stop_requested())
            finally:
                if isinstance(loop.trainer, Trainer):
                    loop.trainer.images.stop_prefetching()
            if loop.trainer.done < loop.total:
                if loop.trainer.done > self._saved:
                    self._save()
                raise KeyboardInterrupt(
                    f"stopped after step {loop.trainer.done}; go on with: dyngs train --resume "
                    f"{quote_path(self.folder)}"
                )
            if self._body_kind is not None and isinstance(loop.trainer, Trainer):
                (self.folder / PICTURES).mkdir(exist_ok=True)
                scene = loop.trainer.model.scene
                picture = self._body_kind.write_avatar_picture(scene, self.folder / PICTURES)
                loop.emit(Message(f"see {picture}"))
            for line in self._reached():
                loop.emit(Message(line))
        write_requested_config(self.folder, self._plan.requested)

    def _save_and_evaluate(self, event: Event) -> None:
        match event:
            case TotalChanged():
                if self.loop.trainer.done < event.total:
                    self._save()  # a resumed run goes on from here with the new schedules
                write_config(self.config, self.folder)
            case StepDone():
                options = self.config.train
                step = event.step
                if options.image_every > 0 and step % options.image_every == 0:
                    self._emit_image(step)
                evaluates = options.eval_every > 0 and step % options.eval_every == 0
                is_last = step == options.steps or event.is_last
                is_due = options.save_every > 0 and step % options.save_every == 0
                is_regular = self._save_timer.is_due(event.seconds)
                if evaluates or is_last or is_due or is_regular:
                    self._save()
                if not self._has_test_views:
                    return
                if evaluates:
                    self._evaluate(step)
                elif options.eval_psnr and (is_last or (is_regular and self._plan.seconds is None)):
                    self._measure_psnr(step)

    def _save(self) -> None:
        start = self.loop.stopwatch.seconds
        checkpoint = self.loop.trainer.checkpoint()
        if not self.folder.is_dir():  # removed, or renamed
            try:
                self.folder.mkdir(parents=True)
            except OSError as error:
                raise DyngsError(f"{self.folder}: cannot be made again: {error}") from error
            write_config(self.config, self.folder)
        path = save_checkpoint(self.folder, checkpoint, self.loop.stopwatch.seconds)
        self._saved = self.loop.trainer.done
        self._save_timer.record_save(start, self.loop.stopwatch.seconds)
        self.loop.emit(Saved(self._saved, path))

    def _evaluate(self, step: int) -> None:
        start = time.perf_counter()
        report = evaluate_run(self.folder, "test", capture=self._plan.capture)
        self._emit_scores(step, start, report.psnr, report.ssim, report.num_views)

    def _measure_psnr(self, step: int) -> None:
        start = time.perf_counter()
        limit = min(_EVAL_FRACTION * self.loop.stopwatch.seconds, _EVAL_SECONDS)
        capture = self._plan.capture
        assert capture is not None
        try:
            mean, num_views = held_out_psnr(self.folder, capture, limit)
        except DyngsError as error:  # the run itself is complete
            self.loop.emit(Message(f"step {step}: test views were not scored: {error}"))
            return
        if num_views:
            self._emit_scores(step, start, mean, None, num_views)

    def _emit_scores(
        self, step: int, start: float, mean: float, ssim: float | None, num_views: int
    ) -> None:
        seconds = time.perf_counter() - start
        self.loop.stopwatch.exclude(seconds)
        self.loop.emit(Evaluated(step, "test", mean, ssim, seconds, num_views))

    def _emit_image(self, step: int) -> None:
        """Render the first test view, or training view without test views; emit it and its
        photo."""
        start = time.perf_counter()
        trainer: Any = self.loop.trainer
        split = "test" if self._has_test_views else "train"
        views = trainer.capture.splits[split]
        image = ImageLoader(views[:1], self.config.data)[0].to(trainer.device)
        background = background_colour(trainer.background)
        with torch.no_grad():
            scene = trainer.model.scene.on_background(background)
            rendered = scene.render(image.cameras, image.time).rgb[0]
        pair = torch.cat([rendered, image.composite(background)], dim=1)
        self.loop.stopwatch.exclude(time.perf_counter() - start)
        self.loop.emit(ProgressImage(step, split, to_uint8(pair.cpu().numpy())))

    def _reached(self) -> Iterator[str]:
        """Yield a line for each limit; a file that is pending is written before its line."""
        trainer = self.loop.trainer
        if self._count is not None:
            yield self._count.reached(self.config, trainer.num_gaussians)
        if self._time is not None:
            yield self._time.reached(self.loop)
            cost = self._time.cost_of_all(self.loop)
            if cost is not None:
                steps = self._time.most_steps
                resume = f"dyngs train --resume {quote_path(self.folder)} train.steps={steps}"
                yield f"{cost}; this run goes on to that with `{resume}`"
        megabytes = self.config.budget.max_mb
        if isinstance(trainer, Trainer) and megabytes is not None:
            yield str(write_limited_file(trainer, self.folder, megabytes))


def _num_threads(config: Config, processes: Processes) -> int:
    """Return the number of threads of the kernels in each process."""
    return config.run.threads or max(1, num_cores() // processes.local_size)
