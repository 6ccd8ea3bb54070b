"""``dyngs.train``: train a run by one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dyngs.api import train as training
from dyngs.api.load import load
from dyngs.capture.preset import choose_preset
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, load_resolved
from dyngs.core.errors import DyngsError, log_info
from dyngs.data.capture import Capture
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.kind import HasGaussians, capability
from dyngs.training.events import Listener
from dyngs.training.losses import AddedLoss, LossFunction

_AFTER_READING = {"root", "downscale", "longest_side", "background", "cache_mb", "follow_links"}
"""Keys of ``data`` that also apply to a capture that is already in memory."""


def train(
    config: Config | Path | str | None = None,
    data: Capture | Mapping[str, Any] | Path | str | None = None,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    run_dir: Path | str | None = None,
    device: str | None = None,
    resume: Path | str | None = None,
    losses: Sequence[LossFunction] = (),
    listeners: Sequence[Listener] = (),
    **keys: Any,
) -> GaussianScene:
    """Train a run and return its scene, which is also in the run folder ``scene.run.path``.

    Nothing is printed. Messages go to the logger ``dyngs``, events to ``listeners``.

    Example:

        import dyngs

        def prefer_dark(look):
            return 0.01 * look.rendered.mean()

        scene = dyngs.train(
            "static",
            data="lego",
            steps=2,
            run_dir="runs/dark",
            losses=[prefer_dark],
            init={"num_random": 50},
            **{"strategy.max_gaussians": 1000},
        )
        scene.run.path, scene.run.step

    Args:
        config: a ``Config``, a preset name or a YAML file; None: the preset that fits the data.
        data: folder, .zip or video (``data.root``), a ``Capture``, or keys of the section.
        steps: ``train.steps``.
        minutes: ``train.minutes``.
        run_dir: ``run.dir``.
        device: ``run.device``.
        resume: a run folder to continue, up to ``steps`` or ``minutes`` if given. Its config is
            fixed; pass ``losses`` again, and a ``Capture`` that you changed.
        losses: functions of a ``dyngs.LossInput`` that return a differentiable scalar tensor,
            which is added to the loss of every step. Pilot runs are without them.
        listeners: functions of one event, see ``dyngs.training.events``.
        keys: any other configuration keys, by dotted name or as nested mappings.

    Raises:
        DyngsError: an unknown key, bad input, a folder that holds another run, or a budget that
            cannot be kept.
        KeyboardInterrupt: after Ctrl-C, once a checkpoint is saved; ``resume`` continues.
    """
    capture = data if isinstance(data, Capture) else None
    root = data if capture is None else capture.root
    added = [AddedLoss(number, function) for number, function in enumerate(losses, 1)]
    changes = {
        "train.steps": steps,
        "train.minutes": minutes,
        "run.dir": run_dir,
        "run.device": device,
        "data" if isinstance(root, Mapping) else "data.root": root,
    }
    changes = {name: value for name, value in changes.items() if value is not None}
    folder = None
    if resume is not None:
        if config is not None or run_dir is not None or keys:
            raise DyngsError(
                "resume: the configuration of a run is fixed; give only steps, minutes, data, "
                "device, losses and listeners"
            )
        folder = Path(resume)
        config = load_resolved(folder)
    else:
        changes |= {"train.losses": [loss.name for loss in added], **keys}
        if config is None:
            own = {name: value for name, value in changes.items() if name.startswith("data")}
            config, reason = choose_preset(load_config(None, own).data)
            log_info(f"preset {config} ({reason})")
    config = config.replace(changes) if isinstance(config, Config) else load_config(config, changes)
    if capability(config.model, HasGaussians) is None:
        raise DyngsError(
            f"model.kind={config.model.kind}: only scenes of Gaussians are trained by dyngs.train; "
            "use `dyngs train`"
        )
    reading = config.data.model_dump(exclude=_AFTER_READING)
    if capture and reading != DataConfig(root=capture.root).model_dump(exclude=_AFTER_READING):
        raise DyngsError(
            "data: keys such as frames have no effect on a capture that was read already; give "
            "them to dyngs.read_capture in a DataConfig"
        )
    run = training.train(
        config, resume_from=folder, listeners=listeners, capture=capture, losses=added
    )
    return load(run)
