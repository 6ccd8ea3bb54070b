"""The configuration of a static scene that stands in for that of a moving one."""

from __future__ import annotations

from typing import TypeVar

from dyngs.config import Config, StaticModel
from dyngs.config.io import load_config, packaged_preset
from dyngs.config.keys.section import Section

S = TypeVar("S", bound=Section)
_LENGTH_AND_LOG = ("steps", "log_every", "save_every", "eval_every", "tensorboard")


def as_still(config: Config) -> Config:
    """Return ``config`` as the preset ``static`` would have it: what a person would have asked for of a static scene.

    Values that differ from those of the preset ``dynamic`` were asked for, and stay where a static one has such a key.
    """
    root = [f"data.root={config.data.root}"]
    still = load_config(packaged_preset("static"), root)
    usual = load_config(packaged_preset("dynamic"), root)
    train = _asked_for(config.train, usual.train, still.train)
    kept = {name: getattr(config.train, name) for name in _LENGTH_AND_LOG}
    return config.model_copy(
        update={
            "model": _asked_for(config.model, usual.model, StaticModel()),
            "init": _asked_for(config.init, usual.init, still.init),
            "strategy": _asked_for(config.strategy, usual.strategy, still.strategy),
            "optim": _asked_for(config.optim, usual.optim, still.optim),
            "train": train.model_copy(update=kept),
        }
    )


def _asked_for(given: Section, usual: Section, still: S) -> S:
    """Return ``still`` with the values of ``given`` that are not the ``usual`` ones, as far as it has such keys.

    A section of another kind than usual was asked for as a whole.
    """
    if type(given) is not type(usual):
        return given  # type: ignore[return-value]
    before, now = usual.model_dump(), given.model_dump()
    changed = {key: getattr(given, key) for key in now if key != "kind" and now[key] != before[key]}
    return still.model_copy(update={key: x for key, x in changed.items() if key in type(still).model_fields})
