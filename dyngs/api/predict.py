"""Prediction of a person's run folder, like that of a trained avatar, from a trained network and a few images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from dyngs.config import Config, DataConfig, HumanModel, HumanPredictorModel
from dyngs.config.io import load_config, load_resolved, packaged_preset
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.errors import DyngsError
from dyngs.files.outputs import new_folder
from dyngs.gaussians.schedule import Rates
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.fit.fitted_capture import with_fitted_body
from dyngs.human.prediction.person import CapturedPerson, named_views, spread_views
from dyngs.human.template.body_reader import load_template
from dyngs.kinds import assemble
from dyngs.runs.checkpoint import latest_checkpoint, save_checkpoint
from dyngs.runs.config_file import write_config
from dyngs.runs.folder import require_empty
from dyngs.training.prediction import PersonPredictor, filmed, human_options, load_network, new_network

_FAINT = 0.02  # Opacity below which a predicted Gaussian is left out, as the preset for one person has it


@dataclass(frozen=True)
class Prediction:
    """Result of ``predict_person``."""

    run_dir: Path
    views: tuple[str, ...]  # names of the images that were predicted from
    num_gaussians: int
    seconds_steps: float  # training the network on these images
    seconds: float  # of the prediction itself


def predict_person(
    network_run: Path,
    capture: Path,
    out: Path,
    views: int | tuple[str, ...],
    *,
    steps: int = 10,
    say: Callable[[str], None] = print,
    report: ReportProgress = report_nothing,
) -> Prediction:
    """Write the person of ``capture`` as a run folder ``out`` for all commands; ``dyngs train --resume`` refines it.

    Args:
        network_run: run folder of ``model.kind: human_predictor``.
        capture: of a person, in any format that has silhouettes; without body parameters the free template is fitted
            to these first, once, as by ``dyngs data fit``.
        out: a new run folder.
        views: how many of the training views to predict from, well spread; or their names.
        steps: of training the network on these images before, see ``PersonPredictor.adapt``.
        say: is told in a line that a body is fitted.
        report: is told how far that fit and these steps have come.

    Raises:
        DyngsError: not such a run or capture, views that are not there, or an ``out`` that is not empty.
    """
    if steps < 0:
        raise DyngsError(f"cannot train for {steps} steps; give 0 or more")
    config, model = network_config(network_run)
    require_empty(out)  # before the work
    network = new_network(model, torch.Generator())
    mean = load_network(network, latest_checkpoint(network_run), model.resolution)
    data = config.data.model_copy(update={"root": capture.absolute()})
    if model.body is None:
        data = with_fitted_body(data, only_if_needed=True, say=say, report=report)
    person = filmed(data, model, load_template(human_options(model)))
    predictor, chosen = PersonPredictor(config, model, network, mean, person), _chosen(person.sitter, views)
    began = time.perf_counter()
    predictor.adapt(chosen, steps, report)
    start = time.perf_counter()
    scene = predictor.predict(chosen)
    scene = scene.select(scene.gaussians.opacities >= _FAINT)
    end = time.perf_counter()
    write_run(out, scene, person.sitter.subject.motion.frames, data, model, end - began)
    names = tuple(person.sitter.views[i].name for i in chosen)
    return Prediction(out, names, len(scene), start - began, end - start)


def network_config(run_dir: Path) -> tuple[Config, HumanPredictorModel]:
    """Return the configuration of the run of a network, and its model section."""
    config = load_resolved(run_dir)
    model = config.model
    if not isinstance(model, HumanPredictorModel):
        raise DyngsError(
            f"{run_dir}: a run of model.kind={config.model.kind}; a prediction needs one of human_predictor"
        )
    return config, model


def write_run(
    out: Path, scene: HumanScene, frames: tuple[int, ...], data: DataConfig, model: HumanPredictorModel, seconds: float
) -> None:
    """Write ``scene`` as a run of the preset for one person after no step."""
    preset = load_config(packaged_preset("human"), ["data.root=."])
    person = preset.model
    if not isinstance(person, HumanModel):
        raise ValueError(f"the preset of one person is of model.kind={preset.model.kind}")
    same = ("body", "uv", "resolution", "near", "eps2d", "rasterize_mode", "sh_degree")
    given = human_options(model)
    human = person.model_copy(update={name: getattr(given, name) for name in same})
    run = preset.run.model_copy(update={"name": out.name, "dir": out})
    config = preset.model_copy(update={"data": data, "model": human, "run": run})
    trainer = assemble(config)
    trainer.model.begin_with(scene, HumanTraining(human, frames, Rates(config.train.steps)))
    with new_folder(out, require_empty) as started:
        write_config(config, started)
        save_checkpoint(started, trainer.checkpoint(), seconds)


def _chosen(sitter: CapturedPerson, views: int | tuple[str, ...]) -> list[int]:
    if isinstance(views, tuple):
        return named_views(sitter, views)
    if not 1 <= views <= len(sitter.views):
        raise DyngsError(f"{sitter.name}: cannot choose {views} of its {len(sitter.views)} training views")
    return spread_views(sitter, views)
