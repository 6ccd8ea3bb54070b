"""The most coarsely rounded file of a scene that is still good enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

from dyngs.config import Config
from dyngs.gaussians.scene import Scene
from dyngs.kinds import restored_scene
from dyngs.models.checkpoint import Checkpoint
from dyngs.storage.drawable import completed, drawable
from dyngs.storage.file import SceneInfo, decoded, encoded
from dyngs.storage.measure import storage_plan
from dyngs.storage.precision import rounded
from dyngs.storage.quantize import step_below
from dyngs.storage.tensors import COARSENESS

FACTORS = tuple(2 ** (k / 2) for k in range(-6, 9))
"""Factors on the usual steps that are tried, by bisection."""


@dataclass(frozen=True)
class CoarseFile:
    """A file in memory.

    Attributes:
        data: its bytes.
        factor: on the usual steps.
        quality: of the scene that is read from it.
        refused: quality at the next coarser steps; None where none were tried.
    """

    data: bytes
    factor: float
    quality: float
    refused: float | None


def coarsest_file(
    config: Config, checkpoint: Checkpoint, quality: Callable[[Scene], float], least: float
) -> CoarseFile | None:
    """Return the file with the coarsest steps tried at which ``quality`` is at least ``least``; None: it never is.

    All steps are those that ``storage_plan`` measures, times one factor. The bytes are read again before they count.

    Args:
        config: of the run.
        checkpoint: of its scene.
        quality: of a scene, the higher the better.
        least: that is enough.
    """
    scene = restored_scene(checkpoint, config.model)
    plan = storage_plan(config, checkpoint, scene, None)
    exact = drawable(scene) | ({} if plan.coarseness is None else {COARSENESS: plan.coarseness})

    def drawn(tensors: dict) -> Scene:
        return restored_scene(Checkpoint(checkpoint.info, tensors), config.model)

    def steps(factor: float) -> dict[str, float]:
        return {name: step and step_below(factor * step) for name, step in plan.precision.steps.items()}

    low, high, refused = 0, len(FACTORS), None
    while low < high:
        middle = (low + high) // 2
        found = quality(drawn(completed(rounded(exact, steps(FACTORS[middle])))))
        if found >= least:
            low = middle + 1
        else:
            refused, high = found, middle
    for index in range(low - 1, -1, -1):
        data = encoded(SceneInfo(**asdict(checkpoint.info)), scene, steps(FACTORS[index]), plan.coarseness)
        found = quality(drawn(decoded(data).tensors))
        if found >= least:
            return CoarseFile(data, FACTORS[index], found, refused)
        refused = found
    return None
