"""Stages that build the plan of a run before its first step. Each returns the changed plan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dyngs.api.choose import resolve_by_pilot_runs
from dyngs.api.first_scene import load_initial_gaussians
from dyngs.capture.sfm.unposed import ensure_poses
from dyngs.config import AutoColour, FixedStrategy, SceneInit, ShColour
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.data.read import (
    capture_folder,
    describe_shrinking,
    read_capture,
    require_folder,
    require_images,
)
from dyngs.models.checkpoint import Checkpoint, read_run_capture
from dyngs.models.kind import HasBody, HasMotion, PredictsScenes, capability, find_kind
from dyngs.models.views import training_times
from dyngs.runs.capture_record import require_same_capture
from dyngs.runs.checkpoint import SCENE_FILE, seconds_at
from dyngs.runs.folder import EXPORT_FOLDER, write_requested_config
from dyngs.training.limits import apply_gaussian_cap, apply_pixel_cap, gaussian_limit
from dyngs.training.new_trainer import add_initial_points
from dyngs.training.plan import (
    RunPlan,
    extend_config,
    with_length,
    with_steps,
)
from dyngs.training.processes import Processes


def share_views(plan: RunPlan, processes: Processes) -> RunPlan:
    """Give each of several processes a view of each step."""
    config = plan.resolved
    if processes.size == 1:
        return plan
    minutes = config.train.minutes
    if minutes is not None:
        raise DyngsError(
            f"train.minutes={minutes:g}: is measured with one process; leave it out, or start "
            "without torchrun"
        )
    if config.train.batch_size == 1:
        train = config.train.model_copy(update={"batch_size": processes.size})
        config = config.model_copy(update={"train": train})
    processes.views_of_process(config.train.batch_size)
    return replace(plan, resolved=config)


def find_poses(plan: RunPlan, report: ProgressCallback) -> RunPlan:
    """Unpack a capture, estimate its poses, and fit a body to a person, where that is needed; what
    is found is kept for other runs."""
    config = plan.resolved
    data = config.data
    model = config.model
    kind = find_kind(model)
    if isinstance(kind, PredictsScenes) or plan.capture is not None:
        return plan  # a folder with a capture per person, or one that was read
    root = data.root
    folder = capture_folder(root)
    data = data.model_copy(update={"root": folder})
    if isinstance(kind, HasBody):
        data = kind.find_body(data, model, log_info, report)
    else:
        data = ensure_poses(data, needs_times=isinstance(kind, HasMotion), report=report)
    if data.root == folder:  # the archive outlives the cache
        data = data.model_copy(update={"root": root})
    if folder != root:
        log_info(f"{root} is unpacked in {folder}")
    return replace(plan, resolved=config.model_copy(update={"data": data}))


def continue_scene(plan: RunPlan) -> RunPlan:
    """Protect the scene that ``init.scene`` names: training starts at full resolution, and with
    frozen Gaussians none are removed and all keep their harmonics."""
    config = plan.resolved
    init = config.init
    if not isinstance(init, SceneInit):
        return plan
    if "init.scene" not in find_kind(config.model).uses:
        raise DyngsError(
            f"init.kind=scene goes with model.kind=static, not with {config.model.kind}"
        )
    keeps = init.trainable == "colour" or init.box is not None
    train = {"initial_downscale": 1} | ({"remove_floaters": False} if keeps else {})
    changes: dict[str, object] = {"train": config.train.model_copy(update=train)}
    if init.trainable == "colour":
        changes["strategy"] = FixedStrategy()
    if keeps and isinstance(config.colour, AutoColour):
        changes["colour"] = ShColour(opacity_entropy=config.colour.opacity_entropy)
    return replace(plan, resolved=config.model_copy(update=changes))


def read_same_capture(plan: RunPlan, folder: Path, resumed: Checkpoint) -> RunPlan:
    """Read the capture of a resumed run in its coordinates."""
    data = plan.resolved.data
    if capability(plan.resolved.model, PredictsScenes) is not None:
        return plan
    capture = read_run_capture(data, resumed.info, plan.capture)
    require_same_capture(folder, data, capture)
    return replace(plan, capture=capture)


def run_pilots(plan: RunPlan, report: ProgressCallback) -> RunPlan:
    """Read the capture, find initial points, and resolve motion by pilot runs."""
    config = plan.resolved
    if capability(config.model, PredictsScenes) is not None:
        return plan
    capture = require_images(plan.capture or read_capture(config.data))
    message = describe_shrinking(capture.splits, config.data)
    if message and "longest_side" not in config.data.model_fields_set:
        log_info(message)
    config, choice = resolve_by_pilot_runs(config, capture, report)
    capture = add_initial_points(capture, config, on_progress=report)
    config = apply_pixel_cap(config, capture)
    return replace(plan, resolved=config, capture=capture, choice=choice)


def find_first_gaussians(plan: RunPlan) -> RunPlan:
    """Read the scene that ``init.scene`` names, where there is one."""
    init = plan.resolved.init
    if not isinstance(init, SceneInit) or plan.capture is None:
        return plan
    first = load_initial_gaussians(plan.resolved, plan.capture)
    assert first is not None
    frozen = 0 if first.frozen is None else int(first.frozen.sum())
    held = f", of which {frozen:,} are frozen" if frozen else ""
    count = format_count(len(first.gaussians), "Gaussian")
    log_info(f"starting from {count} of {init.scene}{held}")
    return replace(plan, first=first)


def set_limits(plan: RunPlan) -> RunPlan:
    """Lower the numbers of Gaussians of the config to the limits of the run."""
    config = plan.resolved
    minutes = config.train.minutes
    num_times = 0 if plan.capture is None else len(set(training_times(plan.capture)))
    seconds = None if minutes is None else 60 * minutes
    most = gaussian_limit(config, num_times)
    capped = apply_gaussian_cap(config, most)
    return replace(plan, resolved=capped, uncapped=config, max_gaussians=most, seconds=seconds)


def extend_run(plan: RunPlan, folder: Path, resumed: Checkpoint | None) -> RunPlan:
    """Set a new number of steps in a resumed run and in its folder."""
    config = plan.resolved
    stored = load_resolved(folder)
    steps = config.train.steps
    minutes = config.train.minutes
    if minutes == stored.train.minutes:
        if steps == stored.train.steps:
            return plan
        minutes = None
    if resumed is None:
        raise DyngsError(
            f"train.steps={steps}: {folder} has no checkpoint to go on from; remove it, or give "
            "another run.dir, and begin with so many steps"
        )
    require_folder(stored.data.root)
    done = resumed.info.step
    requested = with_length(plan.requested, steps, minutes)
    if minutes is not None:  # as many as fit at the same speed; ``TimeLimit`` corrects it
        speed = done / max(seconds_at(folder, done), 1e-3)
        steps = min(steps, max(done + 1, int(60 * minutes * speed)))
    longer = with_length(extend_config(stored, done, steps), steps, minutes)
    if stored.budget.max_mb is not None:
        # otherwise a run that is stopped now would take it for its own
        (folder / EXPORT_FOLDER / SCENE_FILE).unlink(missing_ok=True)
    save_config(longer, folder / RESOLVED_NAME)
    write_requested_config(folder, requested)
    config = extend_config(with_steps(config, stored.train.steps), done, steps)
    config = with_length(config, steps, minutes)
    log_info(
        f"resuming at step {done:,}, extended from {stored.train.steps:,} to "
        f"{format_count(steps, 'step')}; schedules rescaled"
    )
    return replace(plan, requested=requested, resolved=config, is_extended=True)
