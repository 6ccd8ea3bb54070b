"""Trainer of networks that predict people from a few images, on several captures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.models.checkpoint import CONFIG_ADVICE, Checkpoint, CheckpointInfo, checkpoint_settings
from dyngs.models.kind import PredictsScenes, capability
from dyngs.models.prediction import Learner, load_optimizer, optimizer_state, optimizer_step
from dyngs.training.events import StepReport
from dyngs.training.trainer import TrainingEdit, ViewSampler

WARM_UP = 0.05  # Fraction of the run after which the learning rate peaks
WEIGHT_DECAY = 1e-5  # Weight decay of AdamW

_LOWEST = 1e-3  # Ratio of the final to the peak learning rate


@dataclass
class NetworkTrainer:
    """Training state of a network; implements ``Trainable``."""

    config: Config
    learner: Learner[Any]
    optimizer: torch.optim.AdamW
    sampler: ViewSampler  # yields indices of people
    generator: torch.Generator
    done: int = 0
    num_gaussians: int = 0  # of the last predicted person
    bad_gradients: int = 0

    @property
    def num_moving(self) -> int:
        return self.num_gaussians

    def step(self) -> StepReport:
        """Train on one person."""
        step = self.done + 1
        person = self.sampler.next(self.generator, lambda _: True)
        example = self.learner.example(person, step, self.generator)
        value = float(example.loss.detach())
        if not math.isfinite(value):
            raise DyngsError(
                f"step {step}, {self.learner.names[person]}: loss is {value}; lower model.lr"
            )
        self.update(example.loss, step)
        self.done = step
        self.num_gaussians = example.num_gaussians
        return StepReport(
            step,
            value,
            example.image,
            example.rendered,
            example.truth,
            scores=example.scores,
        )

    def update(self, loss: Tensor, step: int) -> None:
        """Run a step of AdamW, skipped if gradients are not finite."""
        rate = one_cycle_rate(self.learner.lr, step, self.config.train.steps)
        self.bad_gradients += not optimizer_step(self.optimizer, self.learner.network, loss, rate)

    def apply(self, edit: TrainingEdit) -> None:
        """Do nothing: networks have no limits that edit a run."""

    def checkpoint(self) -> Checkpoint:
        network = self.learner.network
        tensors = {f"model.network.{name}": x for name, x in network.state_dict().items()}
        tensors |= {f"model.{name}": x for name, x in self.learner.kept().items()}
        tensors["rng"] = self.generator.get_state()
        tensors |= {f"sampler.{name}": x for name, x in self.sampler.state().items()}
        tensors |= {
            f"optimizer.{name}": x for name, x in optimizer_state(self.optimizer, network).items()
        }
        # Predicted radiance fields have no rasterize_mode.
        mode = getattr(self.config.model, "rasterize_mode", RasterizeMode.CLASSIC).value
        info = CheckpointInfo(self.done, 1.0, (0.0, 0.0, 0.0), self.learner.background, mode)
        stored = {name: x.detach().cpu() for name, x in tensors.items()}
        return Checkpoint(info, stored, settings=checkpoint_settings(self.config))

    def restore(self, checkpoint: Checkpoint) -> None:
        self.learner.load(checkpoint)
        with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
            self.sampler.load_state(checkpoint.part("sampler"))
            self.generator.set_state(checkpoint.tensors["rng"])
            load_optimizer(self.optimizer, self.learner.network, checkpoint.part("optimizer"))
        self.done = checkpoint.info.step


def network_trainer(config: Config) -> NetworkTrainer:
    """Return the trainer of a network of any kind, before its first step."""
    network = capability(config.model, PredictsScenes)
    assert network is not None
    generator = torch.Generator().manual_seed(config.run.seed)
    learner = network.networks()[0](config, generator)
    return NetworkTrainer(
        config=config,
        learner=learner,
        optimizer=torch.optim.AdamW(
            learner.network.parameters(), lr=learner.lr, weight_decay=WEIGHT_DECAY
        ),
        sampler=ViewSampler(len(learner.names)),
        generator=generator,
    )


def one_cycle_rate(highest: float, step: int, steps: int) -> float:
    """Return the learning rate at ``step``: linear warm-up, then linear decay (Smith and Topin
    2017)."""
    top = max(1, round(WARM_UP * steps))
    fraction = step / top if step <= top else (steps - step) / max(steps - top, 1)
    return highest * max(fraction, _LOWEST)
