"""Train a run: its folder, its checkpoints and log, its limits, and the loop between them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from itertools import count as counted_from
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from dyngs.api.budget.cost import CostMeter
from dyngs.api.budget.count import count_limit
from dyngs.api.budget.run import LimitedRun
from dyngs.api.budget.size import has_file, write_within
from dyngs.api.budget.time import Deadline, fit_to_time
from dyngs.api.choose import Choice, choose, write_choices
from dyngs.api.following import Leader
from dyngs.api.from_scene import first_of, settled
from dyngs.capture.unposed import with_poses
from dyngs.compress.prune.floaters import FloaterRemoval
from dyngs.compress.prune.stage import PruneStage
from dyngs.config import Config
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, as_word, counted, show, warn
from dyngs.data.capture import Capture
from dyngs.data.read import capture_folder, read_capture, require_folder, require_images
from dyngs.evaluate.report import evaluate_run
from dyngs.gaussians.start import FirstGaussians
from dyngs.io.lock import Held, writing
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.kind import HasBody, HasGaussians, Moves, Predicts, capability, kind_of
from dyngs.ops.device import deterministic, device_for, keep_freed_memory
from dyngs.ops.native import kernel_threads
from dyngs.runs.capture_record import changed_files, named, write_record
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    Checkpoint,
    checkpoint_paths,
    last_good,
    latest_checkpoint,
    remove_old_checkpoints,
    save_checkpoint,
    seconds_at,
    step_of,
)
from dyngs.runs.config_file import write_config
from dyngs.runs.folder import (
    ASKED_NAME,
    EXPORT_FOLDER,
    asked_for,
    begin,
    default_folder,
    is_done,
    note_asked,
    note_root,
    require_startable,
    tidy,
    was_only_begun,
)
from dyngs.runs.inputs import inputs_of
from dyngs.runs.log import RunLog
from dyngs.runs.progress import Progress
from dyngs.training.clock import SaveTimer, Stopwatch
from dyngs.training.events import Evaluated, Event, Listener, Saved, StepDone
from dyngs.training.extend import told, with_length
from dyngs.training.limits import require_possible, shared
from dyngs.training.loop import Interrupts, Loop
from dyngs.training.memory import memory_forecasts, require_room
from dyngs.training.new_trainer import build
from dyngs.training.processes import Processes
from dyngs.training.trainer import Trainer

_COUNT, _TIME = "budget.count", "budget.time"  # Names of the limits' states in a checkpoint


@contextmanager
def _no_progress() -> Iterator[ReportProgress]:
    yield report_nothing


class Limit(Protocol):
    """A listener whose state belongs into checkpoints."""

    def __call__(self, event: Event) -> None: ...

    def state(self) -> dict[str, Tensor]: ...

    def restore(self, stored: dict[str, Tensor]) -> None: ...

    def reached(self) -> str: ...


def train(
    config: Config,
    *,
    resume_from: Path | None = None,
    listeners: Sequence[Listener] = (),
    processes: Processes | None = None,
    progress: Callable[[], AbstractContextManager[ReportProgress]] = _no_progress,
) -> Path:
    """Train and return the run folder.

    Poses of photos and videos are found first, and a body is fitted to a person where that is
    needed.

    Example::

        import dyngs

        overrides = ["data.root=lego", "run.dir=runs/short", "train.steps=2", "init.num_random=50"]
        run = dyngs.train(dyngs.load_config("static", overrides))

    Args:
        config: everything that decides the run; on resuming, that of the run folder, whose
            ``train.steps`` may be changed: the run then goes on to so many, on their schedules
                (``dyngs.training.extend``).
        resume_from: a run folder to go on with, from its newest checkpoint, or from the beginning
            where it was stopped before its first: the result has the same bytes as if the run had
                never stopped.
        listeners: are told everything that happens, see ``dyngs.training.events``.
        processes: that this one, the first of them, leads; None: it is alone.
        progress: shows how far what comes before training is.

    Raises:
        DyngsError: bad input, a run folder that already holds a run or that another process writes
            into, a budget that cannot be kept, no GPU where one is asked for, a loss that is not
            finite, a full disk.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, once a checkpoint is saved; the message says how
            to go on.
    """
    folder = resume_from or config.run.dir or default_folder(config.run.name)
    processes = processes or Processes()
    config = shared(config, processes)
    require_possible(config)
    device_for(config.run.device)
    if resume_from is None and not (folder / RESOLVED_NAME).is_file():
        inputs_of(config).require_output(folder)
    if resume_from is not None and (not folder.is_dir() or _is_done_and_read_only(config, folder)):
        latest_checkpoint(folder)
        return folder
    if resume_from is None:
        with progress() as report:
            config = settled(with_capture(config, report=report))
    keep_freed_memory()
    bytewise = deterministic(device_for(config.run.device), config.run.deterministic)
    with writing(folder) as held, kernel_threads(_num_threads(config, processes)), bytewise:
        tidy(folder, sole_writer=held.alone)
        if resume_from is not None:
            note_root(folder, config.data)
        if resume_from is None and is_done(folder, config) and not _owes_file(config, folder):
            print(_told_again(config, folder), flush=True)
            return folder
        resumed = _start_of_run(config, folder, resuming=resume_from is not None)
        if resume_from is not None:
            config = _with_new_length(config, folder, resumed)
        if (
            resumed is not None
            and resumed.info.step >= config.total_steps
            and not _owes_file(config, folder)
        ):
            print(
                f"{folder}: all {counted(config.total_steps, 'step')} are done; train.steps=N goes on to more",
                flush=True,
            )
            return folder
        asked = asked_for(folder) if resume_from is not None else config
        if resumed is not None:
            resumed.require_settings(config)
        watch = Stopwatch()
        config, choices, capture = _chosen(config, resumed)
        if resumed is not None:
            _warn_of_changed_files(folder, config, capture)
        run = _Run(
            config,
            folder,
            resumed,
            asked,
            capture=capture,
            held=held,
            processes=processes,
            watch=watch,
        )
        write_choices(run.folder, choices)
        lines = run.run(listeners)
        folder = run.folder
        note_asked(folder, asked)
        for line in lines:
            show(line)
    return folder


def _chosen(
    config: Config, resumed: Checkpoint | None
) -> tuple[Config, list[Choice], Capture | None]:
    """Return the configuration with all decided, what was said, and the capture, which nothing
    reads again."""
    if capability(config.model, Predicts) is not None:
        return config, [], None  # it has several captures
    if resumed is not None:
        return config, [], read_capture_of(config.data, resumed.info)
    return choose(config, require_images(read_capture(config.data)))


def _told_again(config: Config, folder: Path) -> str:
    longer = (
        ""
        if config.prune.is_wanted
        else f", go on with `dyngs train --resume {as_word(folder)} train.steps=N`"
    )
    return (
        f"{folder} holds just this run, finished, and training again would end with the same bytes: nothing is done; "
        f"look at it with `dyngs eval {as_word(folder)}`{longer}, or give another run.dir"
    )


class _Run:
    """A run from the reading of its capture to its last line.

    Args:
        resumed: what it goes on from; None: it begins.
        asked: the configuration that was asked for, from which this one was chosen.
        held: the lock of the folder, which knows where that is if it is renamed.
        watch: seconds since the capture was read, which include those of short trainings before the
            run.
    """

    def __init__(
        self,
        config: Config,
        folder: Path,
        resumed: Checkpoint | None,
        asked: Config,
        *,
        capture: Capture | None,
        held: Held,
        processes: Processes,
        watch: Stopwatch,
    ) -> None:
        if resumed is None:
            require_room(config)
        first = None if resumed is not None or capture is None else first_of(config, capture)
        trainer = build(config, capture, restored=resumed is not None, first=first)
        self._held, self._capture = held, capture
        self.folder, self.limits = folder, dict[str, Limit]()
        self.loop = Loop(trainer, config.total_steps, watch, lambda: last_good(self.folder))
        self._leader = Leader(processes, config, _num_threads(config, processes))
        self.loop.before_step = self._leader.before_step
        if resumed is not None:
            trainer.restore(resumed)
            watch.pause(-seconds_at(folder, resumed.info.step))
        self.limited = (
            LimitedRun(folder, config, self.loop, trainer) if isinstance(trainer, Trainer) else None
        )
        self._config = config
        self._saved = self.loop.trainer.done
        self._save_timer = SaveTimer(config.train.save_minutes, watch.seconds)
        has_gaussians = capability(config.model, HasGaussians) is not None
        self._gaussians = self.limited if has_gaussians else None
        if self._gaussians is not None:
            _tell_memory(self._gaussians.trainer, processes.local_size)
        self._meter: CostMeter | None = None
        if self.limited is not None:
            self._set_limits(self.limited, resumed, first)
        self._follow(held.folder() or folder)
        if resumed is None:
            begin(self.folder, self.config)
            note_asked(self.folder, asked)
            write_record(self.folder, config.data, capture)

    @property
    def config(self) -> Config:
        """The configuration as saved; limits may change the number of steps."""
        return self._config if self.limited is None else self.limited.config

    def run(self, listeners: Sequence[Listener]) -> list[str]:
        """Step until the end, or until interrupted, and keep the limits; return a line for each
        limit."""
        options = self.config.train
        loop = self.loop
        done = self.loop.trainer.done
        with (
            RunLog(
                self.folder, done, every=options.log_every, tensorboard=options.tensorboard
            ) as log,
            Progress(loop.total, done, options.log_every, config=lambda: self.config) as progress,
            Interrupts() as interrupts,
        ):
            measures = [] if self._meter is None else [self._meter]
            gaussians = self._gaussians
            if gaussians is not None:
                loop.subscribe(FloaterRemoval(loop, lambda: gaussians.trainer))
            loop.subscribe(
                self._leader,
                *measures,
                *self.limits.values(),
                log,
                progress,
                *listeners,
                self._save_and_evaluate,
            )
            if gaussians is not None:
                loop.subscribe(PruneStage(loop, lambda: gaussians.trainer))
            try:
                loop.run(lambda: interrupts.requested or self._leader.processes.is_stop_requested())
            finally:
                if isinstance(loop.trainer, Trainer):
                    loop.trainer.images.rest()
            if loop.trainer.done < loop.total:
                self._follow(self._held.folder() or self.folder)
                if loop.trainer.done > self._saved:
                    self._save()
                raise KeyboardInterrupt(
                    f"stopped after step {loop.trainer.done}; go on with: dyngs train --resume {as_word(self.folder)}"
                )
        return list(self._reached())

    def _set_limits(
        self, run: LimitedRun, resumed: Checkpoint | None, first: FirstGaussians | None
    ) -> None:
        minutes = run.config.train.minutes
        if minutes is not None:
            run.given = 60 * minutes
            wanted = run.config.train.steps
            refit_seconds = 0.0
            if resumed is None:
                refit_seconds = fit_to_time(run, first, show)
                self.loop.total = run.config.total_steps
            self.limits[_TIME] = Deadline(
                run, wanted, fits=resumed is None, refit_seconds=refit_seconds, save=self._save
            )
            self._meter = (
                CostMeter(run, wanted) if resumed is None and self._gaussians is not None else None
            )
        count = count_limit(run)
        if count is not None:
            self.limits[_COUNT] = count
            if resumed is not None:
                count.restore(resumed.part(_COUNT))

    def _save_and_evaluate(self, event: Event) -> None:
        match event:
            case StepDone():
                options = self.config.train
                step = event.step
                evaluates = options.eval_every > 0 and step % options.eval_every == 0
                is_last = step == options.steps or event.is_last
                is_due = options.save_every > 0 and step % options.save_every == 0
                if evaluates or is_last or is_due or self._save_timer.is_due(event.seconds):
                    self._save()
                if evaluates and event.loop.trainer.has_test_views:
                    self._evaluate(step)

    def _save(self) -> None:
        begin = self.loop.watch.seconds
        checkpoint = self.loop.trainer.checkpoint()
        for part, limit in self.limits.items():
            kept = {f"{part}.{name}": x for name, x in limit.state().items()}
            checkpoint = replace(checkpoint, tensors=checkpoint.tensors | kept)
        found = self._held.folder()
        self._follow(found or _free(self.folder))
        if found is None:
            write_config(self.config, self.folder)
        path = save_checkpoint(self.folder, checkpoint, self.loop.watch.seconds)
        if found is None:
            done = self.loop.trainer.done
            again = f"dyngs train --resume {as_word(self.folder)}"
            raise DyngsError(
                f"the folder of the run was removed, or moved to another disk; the checkpoint after step {done} is in "
                f"{self.folder}; go on with `{again}`"
            )
        self._saved = self.loop.trainer.done
        self._save_timer.saved(begin, self.loop.watch.seconds)
        self.loop.tell(Saved(self._saved, path))

    def _follow(self, folder: Path) -> None:
        """Go on in ``folder``, which that of the run is called by now."""
        self.folder = folder
        if self.limited is not None:
            self.limited.folder = folder

    def _evaluate(self, step: int) -> None:
        start = time.perf_counter()
        report = evaluate_run(self.folder, "test", capture=self._capture)
        seconds = time.perf_counter() - start
        self.loop.watch.pause(seconds)
        self.loop.tell(Evaluated(step, "test", report.psnr, report.ssim, seconds))

    def _how_to_go_on(self, steps: int) -> str:
        """Return what to do after a preview for a run of all ``steps``."""
        try:
            with_length(self.config, self.loop.trainer.done, steps)
        except DyngsError:  # motion began too early for so many
            return "for that train anew without train.minutes"
        longer = f"`dyngs train --resume {as_word(self.folder)} train.steps={steps}`"
        return f"this run goes on to that with {longer}, or train anew without train.minutes"

    def _reached(self) -> Iterator[str]:
        """Yield a line for each limit; what is still owed is done before its line."""
        for part in (_COUNT, _TIME):
            if part in self.limits:
                yield self.limits[part].reached()
        cost = (
            None
            if self._meter is None or self._meter.steps <= self.loop.trainer.done
            else self._meter.found()
        )
        if cost is not None:
            yield f"{cost}; {self._how_to_go_on(cost.steps)}"
        if self.limited is not None and self.config.budget.max_mb is not None:
            yield str(write_within(self.limited.trainer, self.folder, self.config.budget.max_mb))


def _warn_of_changed_files(folder: Path, config: Config, capture: Capture | None) -> None:
    """Print which files of the capture have changed since the run began. Raises DyngsError: it is
    another capture."""
    changed = changed_files(folder, config.data, capture)
    if changed:
        views = counted(len(changed), "training view")
        line = f"files of {views} have changed since the run began: {named(changed)}"
        warn(line)


def _tell_memory(trainer: Trainer[Any], processes: int) -> None:
    """Print how much memory a run will take, and a warning where that is likely to be more than is
    there."""
    for forecast in memory_forecasts(trainer, processes):
        print(forecast, flush=True)
        forecast.require_possible()
        warning = forecast.warning()
        if warning is not None:
            warn(warning)


def _free(folder: Path) -> Path:
    """Return ``folder`` if nothing is there, else one of a similar name."""
    names = (folder.with_name(f"{folder.name}_{number}") for number in counted_from(2))
    return (
        folder
        if not os.path.lexists(folder)
        else next(path for path in names if not os.path.lexists(path))
    )


def _is_done_and_read_only(config: Config, folder: Path) -> bool:
    """Return whether nothing is to be done in the run folder, and nothing can be."""
    paths = checkpoint_paths(folder)
    is_done = (
        bool(paths) and step_of(paths[-1]) >= config.total_steps and not _owes_file(config, folder)
    )
    return is_done and not os.access(folder, os.W_OK)


def _owes_file(config: Config, folder: Path) -> bool:
    return config.budget.max_mb is not None and not has_file(folder)


def _start_of_run(config: Config, folder: Path, *, resuming: bool) -> Checkpoint | None:
    """Return the checkpoint to go on from; None for a run that begins, or that was stopped before
    its first."""
    if not resuming:
        require_startable(folder, config)
        return None
    if was_only_begun(folder):
        return None
    checkpoint = latest_checkpoint(folder)
    remove_old_checkpoints(folder)
    return checkpoint


def _with_new_length(config: Config, folder: Path, resumed: Checkpoint | None) -> Config:
    """Return ``config`` of a resumed run, changed in its folder, too, where it asks for another
    number of steps."""
    stored = load_resolved(folder)
    steps = config.train.steps
    was = stored.train.steps
    if steps == was:
        return config
    if resumed is None:
        raise DyngsError(
            f"train.steps={steps}: {folder} has no checkpoint to go on from; remove it, or give another run.dir, and "
            "begin with so many steps"
        )
    require_folder(stored.data.root)
    done = resumed.info.step
    longer = with_length(stored, done, steps)
    print(told(stored, longer, done), flush=True)
    if stored.budget.max_mb is not None:
        # otherwise a run that is stopped now would take it for its own
        (folder / EXPORT_FOLDER / SCENE_FILE).unlink(missing_ok=True)
    save_config(longer, folder / RESOLVED_NAME)
    (folder / ASKED_NAME).unlink(missing_ok=True)  # what was asked for now is what is there
    return with_length(
        config.model_copy(update={"train": config.train.model_copy(update={"steps": was})}),
        done,
        steps,
    )


def _num_threads(config: Config, processes: Processes) -> int:
    """Return the number of threads of the kernels in each process."""
    return config.run.threads or max(1, num_cores() // processes.local_size)


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def with_capture(
    config: Config, *, say: Callable[[str], None] = show, report: ReportProgress = report_nothing
) -> Config:
    """Return the configuration with a capture that can be trained on; what is found for it is kept
    for other runs."""
    data = config.data
    root = data.root
    folder = capture_folder(root)
    if folder != root:
        say(f"{root} is unpacked in {folder}")
        data = data.model_copy(update={"root": folder})
    kind = kind_of(config.model)
    if isinstance(kind, HasBody):
        data = kind.find_body(data, config.model, say, report)
    elif not isinstance(kind, Predicts):  # whose folder holds a capture per person
        moves = isinstance(kind, Moves)
        data = with_poses(data, needs_times=moves, say=say, report=report)
    if data.root == folder:  # the archive outlives the cache
        data = data.model_copy(update={"root": root})
    return config.model_copy(update={"data": data})
