"""Choice of the default run folder: a new one, or that of a run that is continued."""

from __future__ import annotations

from itertools import count
from pathlib import Path

from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.config.keys.train import LOGGING_KEYS
from dyngs.core.errors import DyngsError, format_count, log_info, quote_path
from dyngs.runs.checkpoint import checkpoint_paths, checkpoint_step
from dyngs.runs.folder import differing_keys, load_requested_config, require_startable
from dyngs.training.plan import extend_config, with_length


def choose_run(base: Path, config: Config, *, continues: bool = True) -> tuple[Path, Config | None]:
    """Return the run folder for ``config``, and the config of the run in it if that is continued.

    It is the first of ``base``, ``base-2``, ... that has no run, or one with the same keys that is
    not longer. The folder and the reason are logged if it is not a new ``base``. ``continues`` is
    false for captures in memory, whose images may differ.
    """
    problem = ""
    for number in count(1):
        folder = base if number == 1 else base.with_name(f"{base.name}-{number}")
        continued = None
        try:
            if continues and checkpoint_paths(folder):
                continued = _continue_run(folder, config)
            else:
                require_startable(folder, config)
        except DyngsError as error:
            problem = problem or str(error)
            continue
        if problem or continued is not None:
            why = f"{problem}; " if problem else ""
            log_info(f"{why}run folder: {folder}{' (existing run)' if continued else ''}")
        return folder, continued
    raise AssertionError


def _continue_run(folder: Path, config: Config) -> Config:
    """Return the config with which the run in ``folder`` continues to the length of ``config``.

    Raises DyngsError: the run has other keys, or a new run may give a better result.
    """
    stored = load_resolved(folder)
    requested = load_requested_config(folder)
    done = checkpoint_step(checkpoint_paths(folder)[-1])
    steps = config.train.steps
    minutes = config.train.minutes
    former = requested.train
    different = differing_keys(with_length(requested, steps, minutes), config)
    if different:
        raise DyngsError(f"{folder} has a run with other values of {', '.join(different[:4])}")
    logging = {key: getattr(config.train, key) for key in LOGGING_KEYS}
    train = stored.train.model_copy(update=logging)
    continued = stored.model_copy(update={"train": train, "run": config.run})
    if (steps, minutes) == (former.steps, former.minutes):
        return continued
    is_later = minutes is None or (former.minutes is not None and minutes > former.minutes)
    if not is_later or steps < (former.steps if former.minutes is None else done):
        raise DyngsError(f"{folder} has a run of {format_count(former.steps, 'step')}")
    hint = f"(`dyngs train --resume {quote_path(folder)} train.steps={steps}` continues it)"
    if getattr(config.model, "pilot_runs", False):
        raise DyngsError(f"{folder} has a shorter run, for which its pilot runs were made {hint}")
    if former.minutes is not None and stored.data.longest_side != requested.data.longest_side:
        raise DyngsError(f"{folder} has a preview with smaller images {hint}")
    if steps == done:
        return continued
    extend_config(stored, done, steps)  # raises if the run cannot be extended
    return with_length(continued, steps, minutes)
