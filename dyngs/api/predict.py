"""Predict a person from a few images with a trained network, and write a run folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, log_info
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.outputs import atomic_folder
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import PredictsScenes, capability
from dyngs.models.prediction import Predictor, find_views
from dyngs.models.renderable import Renderable
from dyngs.runs.checkpoint import latest_checkpoint, save_checkpoint
from dyngs.runs.folder import require_empty, write_config
from dyngs.runs.network_file import published_network, read_network
from dyngs.training.new_trainer import build_trainer


@dataclass(frozen=True)
class Prediction:
    """Result of ``predict``."""

    run_dir: Path
    views: tuple[str, ...]  # names of the images that were predicted from
    num_gaussians: int  # 0: the scene is made of something else
    steps: int  # of training the network on these images
    seconds_steps: float  # that these took
    seconds: float  # of the prediction itself


def predict(
    network: Path,
    capture: Path,
    out: Path,
    views: int | tuple[str, ...] | None = None,
    *,
    steps: int | None = None,
    report: ProgressCallback = ignore_progress,
) -> Prediction:
    """Write the person of ``capture`` as a run folder ``out`` for all commands; ``dyngs train
    --resume`` refines it.

    Args:
        network: run folder of a network that predicts people, see ``dyngs.models.prediction``, a
            file of its weights, see ``dyngs.runs.network_file``, or the name of published ones.
        capture: of a person, in any format that has silhouettes.
        out: a new run folder.
        views: how many of the training views to predict from; or their names; None: as many as the
            network is for.
        steps: of training the network on these images before; None: as many as usual for such a
            network.
        report: called with the progress of these steps and of what takes long before.

    Raises:
        DyngsError: not such a run or capture, views that are not there or do not suit, or an
            ``out`` that is not empty.
    """
    if steps is not None and steps < 0:
        raise DyngsError(f"cannot train for {steps} steps; give 0 or more")
    config, checkpoint = read_trained_network(network)
    require_empty(out)  # before the work
    data = config.data.model_copy(update={"root": capture.absolute()})
    network_kind = require_network(config, network)
    predictor = network_kind.networks()[1](config, checkpoint, data, log_info, report)
    chosen = _chosen(predictor, network_kind.num_views(config.model) if views is None else views)
    began = time.perf_counter()
    done = predictor.adapt(chosen, steps, report)
    start = time.perf_counter()
    scene = predictor.predict(chosen)
    end = time.perf_counter()
    write_run(out, predictor, chosen, scene, end - began)
    names = tuple(predictor.views[i].name for i in chosen)
    count = len(scene) if isinstance(scene, GaussianScene) else 0
    return Prediction(out, names, count, done, start - began, end - start)


def read_trained_network(network: Path) -> tuple[Config, Checkpoint]:
    """Return configuration and weights of a network: its run, a file, or a name in ``WEIGHTS``.

    Raises DyngsError: unknown or unreadable.
    """
    if not network.exists() and network.name == str(network):
        network = published_network(network.name)
    if network.is_file():
        return read_network(network)
    config = network_config(network)
    return config, latest_checkpoint(network)


def network_config(run_dir: Path) -> Config:
    """Return the configuration of the run of a network. Raises DyngsError: it is of something
    else."""
    config = load_resolved(run_dir)
    require_network(config, run_dir)
    return config


def require_network(config: Config, run_dir: Path) -> PredictsScenes:
    """Return the kind of a network. Raises DyngsError: it is another kind."""
    network = capability(config.model, PredictsScenes)
    if network is None:
        raise DyngsError(
            f"{run_dir}: a run of model.kind={config.model.kind}; a prediction needs the run of a network "
            "(`dyngs docs people`)"
        )
    return network


def write_run(
    out: Path, predictor: Predictor, views: Sequence[int], scene: Renderable, seconds: float
) -> None:
    """Write ``scene``, which was predicted from ``views``, as a run after no step."""
    config = predictor.run_config(views)
    config = config.model_copy(
        update={"run": config.run.model_copy(update={"name": out.name, "dir": out})}
    )
    # a run that takes no step needs no priors
    without_priors = config.train.model_copy(update={"priors": ()})
    trainer = build_trainer(config.model_copy(update={"train": without_priors}), restored=True)
    predictor.begin(trainer.model, scene, config)
    with atomic_folder(out, require_empty) as started:
        write_config(config, started)
        save_checkpoint(started, trainer.checkpoint(), seconds)


def _chosen(predictor: Predictor, views: int | tuple[str, ...]) -> list[int]:
    if isinstance(views, tuple):
        return find_views(predictor.name, predictor.views, views)
    if not 1 <= views <= len(predictor.views):
        raise DyngsError(
            f"{predictor.name}: cannot choose {views} of its {len(predictor.views)} training views"
        )
    return predictor.chosen(views)
