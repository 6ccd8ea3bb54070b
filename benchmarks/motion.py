"""Gap between what is learned and what could be, if the motion were known, on the synthetic scenes
that move.

    python benchmarks/motion.py FOLDER [--scenes spin,room] [--size 200] [--views 48] [--style
    moving]
        [key=value ...]

For each scene two models are trained for the same number of steps and measured on the test split:
the preset (configs/dynamic.yaml with the overrides), and an oracle. The oracle's Gaussians begin on
the true surfaces, with labels of what they belong to, and a field moves them by the scene's own
description of each rigid body. The rasterizer, the strategy, the learning rates and the
harmonics are the preset's, the base colours of what moves may change over time, and images have
their full size from the start. The gap is what it costs to find the motion; shading and shadows
hold back both. FOLDER keeps captures and runs of the preset, which are reused.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from dyngs.api.load import read_capture
from dyngs.api.train import train
from dyngs.config import Config, PointsInit, RandomInit
from dyngs.config.io import load_config
from dyngs.core.metrics import Lpips
from dyngs.core.state import Role
from dyngs.data.capture import PointCloud, View
from dyngs.data.loader import ImageLoader
from dyngs.data.synthetic.captures import (
    CAMERA_ANGLE_X,
    CaptureStyle,
    DynamicOptions,
    Primitive,
    SceneName,
    nearest_primitives,
    scene_at,
    write_dynamic_capture,
)
from dyngs.data.synthetic.captures import Scene as TrueScene
from dyngs.data.times import evenly_spaced
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, select_rows
from dyngs.deform.random_gaussians import box_of
from dyngs.deform.scene import DynamicScene
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.evaluate.report import evaluate_run, split_views
from dyngs.evaluate.view_scores import Regions, score_views
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.initialization import InitialValues, initial_gaussians
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.schedule import RateSchedule
from dyngs.gaussians.static_training import StaticTraining
from dyngs.models.static_section import StaticModel
from dyngs.models.views import training_times
from dyngs.ops.adam import Count
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.training.new_trainer import GaussianTrainer, build_trainer

PRESET = Path(__file__).parents[1] / "configs" / "dynamic.yaml"
REST = 1.0
"""Time at which the oracle's canonical Gaussians lie on their surfaces: everything exists then."""
# world units by which a surface may seem to lie before one of its own points
SURFACE_TOLERANCE = 3e-3
PER_MOVER, MOST_STILL = 1500, 3000
"""Points on the surface of each thing that moves, and of each that stands, at most."""
DRAWN, LOOKS = 20_000, 16
"""Points that are drawn per thing, of which those that one of so many training views sees are
kept."""
GONE = -30.0
"""Logit opacity by which what does not exist is dimmed."""
POWERS, FREQUENCIES = 3, 2
"""Of time, in the base colours that are learned."""


@dataclass(frozen=True)
class Motion:
    """A rigid or uniformly scaled motion x' = A x + b from the rest, or none where the thing does
    not exist."""

    matrix: Tensor
    shift: Tensor

    @staticmethod
    def between(rest: Primitive, now: Primitive) -> Motion:
        """Return the motion of ``rest`` to ``now``, two states of one ball or box."""
        corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        moved = now.to_world(rest.local(corners)).astype(np.float64)
        return Motion(
            torch.from_numpy((moved[1:] - moved[0]).T).float(), torch.from_numpy(moved[0]).float()
        )

    @property
    def scale(self) -> float:
        """Factor of sizes."""
        return max(float(torch.linalg.det(self.matrix.double())), 1e-18) ** (1 / 3)

    @property
    def quat(self) -> Tensor:
        """(4,) unit quaternion wxyz of its rotation."""
        from scipy.spatial.transform import Rotation

        x, y, z, w = Rotation.from_matrix((self.matrix / self.scale).double().numpy()).as_quat()
        return torch.tensor([w, x, y, z], dtype=torch.float32, device="cpu")


class TrueMotion(DeformationField):
    """The motion of a synthetic scene as a field of which only the base colours over time are
    learned.

    Args:
        name: of the scene.
        labels: (M,) primitive that each moving Gaussian belongs to.
        setup: as for any field.
    """

    def __init__(self, name: SceneName, labels: Tensor, setup: FieldSetup) -> None:
        self.setup = setup
        terms = POWERS + 2 * FREQUENCIES
        start = {"colors": torch.zeros(setup.num_moving, terms, 3, device="cpu")}
        self.parameters = Parameters(start, {"colors": 1e-3}, 0.01, Role.PER_MOVING)
        self.labels, self.rest = labels, scene_at(name, REST).primitives
        self.primitives_at = cache(lambda time: scene_at(name, time).primitives)

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        """See ``DeformationField.offsets``; differentiable in ``means``, as rotations turn what
        they learn."""
        x = 2 * time - 1
        turns = [2 * np.pi * k * time for k in range(1, FREQUENCIES + 1)]
        terms = [x**k for k in range(1, POWERS + 1)] + [
            f(angle) for angle in turns for f in (np.sin, np.cos)
        ]
        colors = torch.einsum(
            "b,mbd->md", means.new_tensor(terms), select_rows(self.parameters["colors"], rows)
        )
        labels = select_rows(self.labels, rows)
        means = select_rows(means, rows)
        moved = means.clone()
        quats = means.new_tensor([1.0, 0, 0, 0]).repeat(len(means), 1)
        scales = means.new_zeros(len(means), 3)
        opacities = means.new_zeros(len(means))
        now = self.primitives_at(time)
        for label in self.labels.unique().tolist():
            own = torch.nonzero(labels == label)[:, 0]
            rest = self.rest[label]
            if label >= len(now):
                opacities[own] = GONE
            else:
                motion = Motion.between(rest, now[label])
                moved = moved.index_copy(0, own, means[own] @ motion.matrix.T + motion.shift)
                quats[own], scales[own] = motion.quat, float(np.log(motion.scale))
        return Offsets(
            moved - means, quats - quats.new_tensor([1.0, 0, 0, 0]), scales, opacities, colors
        )

    def apply_edit(self, edit: TopologyEdit) -> TrueMotion:
        field = self.with_parameters(self.parameters.apply_edit(Role.PER_MOVING, edit))
        field.labels = self.labels[edit.source]
        return field


class OracleTraining(StaticTraining):
    """Training of colours and Gaussians while the motion is given."""

    deformation_name = ("true motion", "optim")

    def __init__(self, steps: int) -> None:
        super().__init__(FilterUpdate())
        self._rates = RateSchedule(steps)

    def optimize(self, scene: GaussianScene, step: int) -> Count:
        assert isinstance(scene, DynamicScene)
        assert scene.field is not None
        return scene.field.parameters.step(step, self._rates.progress(step))


def oracle(name: SceneName, config: Config, seed: int = 0) -> GaussianTrainer:
    """Return the trainer of the oracle of a scene; its capture must be that of ``config``."""
    model = StaticModel(sh_degree=config.model.sh_degree)
    init = RandomInit(num_random=100)
    sizes = config.train.model_copy(update={"initial_downscale": 1})
    config = config.model_copy(update={"model": model, "init": init, "train": sizes})
    capture = read_capture(config.data)  # in the unit of the files, in which the true motion is
    trainer = build_trainer(config, capture)
    points, colours, labels = surface_points(name, capture.splits["train"], seed)
    start = replace(capture, points=PointCloud(points, colours))
    generator = torch.Generator().manual_seed(seed)
    values = InitialValues.for_strategy(config.strategy)
    gaussians = initial_gaussians(start, PointsInit(), values, model.sh_degree, generator)
    moving = torch.nonzero(labels >= scene_at(name, REST).moving_indices.start)[:, 0]
    times = tuple(sorted(set(training_times(capture))))
    setup = FieldSetup(*box_of(gaussians, trainer.extent), len(times), len(moving), trainer.extent)
    scene = DynamicScene(
        gaussians=gaussians,
        training_times=times,
        field=TrueMotion(name, labels[moving], setup),
        moving=moving,
    )
    trainer.model.start_from(scene, OracleTraining(config.train.steps))
    return trainer


def surface_points(
    name: SceneName, views: Sequence[View], seed: int
) -> tuple[np.ndarray, np.ndarray, Tensor]:
    """Return points (P, 3) at rest that training views see, their colours (P, 3) uint8, and the
    primitive of each."""
    random = np.random.default_rng(seed)
    rest = scene_at(name, REST)
    looks = [views[i] for i in evenly_spaced(len(views), LOOKS)]
    points = []
    colours = []
    labels = []
    for label, primitive in enumerate(rest.primitives):
        local = primitive.sample_surface(
            DRAWN if label not in rest.moving_indices else 2 * PER_MOVER, random
        )
        local = local[_seen(name, label, local, looks)][
            : PER_MOVER if label in rest.moving_indices else MOST_STILL
        ]
        points.append(primitive.to_world(local))
        colours.append(
            (255 * np.clip(0.8 * primitive.paint(local), 0, 1) ** (1 / 2.2)).astype(np.uint8)
        )
        labels += [label] * len(local)
    return np.concatenate(points), np.concatenate(colours), torch.tensor(labels, device="cpu")


def _seen(name: SceneName, label: int, local: np.ndarray, looks: Sequence[View]) -> np.ndarray:
    """Return (R,) bool: points of a primitive that one of the views sees at its time."""
    seen = np.zeros(len(local), bool)
    for view in looks:
        scene: TrueScene = scene_at(name, view.time or 0.0)
        if label < len(scene.primitives):
            pose = np.linalg.inv(view.cam_from_world) @ np.diag([1.0, -1.0, -1.0, 1.0])
            points = scene.primitives[label].to_world(local)
            offset = points - pose[:3, 3]
            x, y, z = (offset @ pose[:3, :3]).T
            reach = np.tan(0.5 * CAMERA_ANGLE_X) * -z
            is_inside = (z < 0) & (np.abs(x) < reach) & (np.abs(y) < reach)
            distance = np.linalg.norm(offset, axis=1)
            ways = (offset / distance[:, None]).astype(np.float32)
            _, nearest = nearest_primitives(scene, pose[:3, 3].astype(np.float32), ways)
            seen |= is_inside & (nearest > distance - SURFACE_TOLERANCE)
    return seen


@dataclass(frozen=True)
class Row:
    """What is printed of a model: PSNR in dB of whole images and of parts, and Gaussians."""

    psnr: float
    foreground: float | None
    moving: float | None
    still: float | None
    gaussians: int = 0

    def minus(self, other: Row) -> Row:
        """Return the differences; None where one is not known."""
        names = ("foreground", "moving", "still")
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in names}
        parts = {name: None if a is None or b is None else a - b for name, (a, b) in pairs.items()}
        return Row(self.psnr - other.psnr, gaussians=0, **parts)

    def line(self, scene: str, model: str) -> str:
        """Return a row of the table."""
        values = (self.psnr, self.foreground, self.moving, self.still)
        shown = [f"{x:.2f}" if x is not None else "-" for x in values]
        return f"| {scene} | {model} | {' | '.join(shown)} | {self.gaussians or ''} |"


def measured(scene: GaussianScene, config: Config) -> Row:
    """Return the scores of a scene in memory on the test split."""
    capture = read_capture(config.data)
    views = split_views(capture, "test")
    background = scene.background if scene.background is not None else torch.zeros(3, device="cpu")
    loader = ImageLoader(views, config.data)
    regions = Regions(views, MotionMasks(capture, config.data))
    images = (loader[i] for i in range(len(loader)))
    scores, _ = score_views(
        scene, images, scene.options, background, Lpips("alex", "not measured"), regions
    )
    return Row(
        psnr=fmean(score.psnr for score in scores),
        foreground=_mean(score.psnr_foreground for score in scores),
        moving=_mean(score.psnr_moving for score in scores),
        still=_mean(score.psnr_static for score in scores),
        gaussians=len(scene),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def preset_row(config: Config, run: Path) -> Row:
    """Return the scores of the preset's run, which is trained where it is not there."""
    if not checkpoint_paths(run):
        train(config)
    report = evaluate_run(run)
    parts = report.psnr_foreground, report.psnr_moving, report.psnr_static
    return Row(report.psnr, *parts, report.num_gaussians)


def oracle_row(name: SceneName, config: Config) -> Row:
    """Return the scores of the oracle, trained anew."""
    trainer = oracle(name, config)
    with kernel_threads(config.run.threads or torch.get_num_threads()):
        for _ in range(config.train.steps):
            trainer.step()
        return measured(trainer.model.scene, config)


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--scenes", default=",".join(get_args(SceneName)))
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument(
        "--style", choices=get_args(CaptureStyle), help="as dyngs data synth; one per FOLDER"
    )
    given = parser.parse_intermixed_args(words)
    print("| scene | model | PSNR | foreground | moves | stands | Gaussians |")
    print("|---|---|---|---|---|---|---|")
    for name in get_args(SceneName):
        if name not in given.scenes.split(","):
            continue
        root = given.folder / name
        run = given.folder / f"{name}_run"
        if not root.is_dir():
            options = DynamicOptions(size=given.size, num_times=given.views, style=given.style)
            write_dynamic_capture(name, root, options)
        config = load_config(PRESET, [*given.overrides, f"data.root={root}", f"run.dir={run}"])
        learned = preset_row(config, run)
        known = oracle_row(name, config)
        for row, model in ((learned, "preset"), (known, "oracle"), (known.minus(learned), "gap")):
            print(row.line(name, model), flush=True)


if __name__ == "__main__":
    main()
