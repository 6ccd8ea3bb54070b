"""What spoils a scene when it is looked at from elsewhere: measured over training views where there
are any, and taken away as far as views that judge nothing lose no more than is allowed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.compress.floaters import FEWEST_VIEWS, floaters
from dyngs.compress.search import evenly_held_out, unseen_images
from dyngs.compress.stage import importance, quality_of, scoring_views
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, counted
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.kind import HasGaussians, capability
from dyngs.ops.device import deterministic, device_for
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.checkpoint import has_only_scene_file, latest_checkpoint, load_run
from dyngs.training.new_trainer import GaussianTrainer, assemble

NEEDLE = 20.0  # longest axis over the second longest
# opacity below which large Gaussians veil what is behind; size over the median size
VEIL, LARGE = 0.1, 4.0
FAINT = 2 / 255  # opacity below which a Gaussian hardly shows
LONE, NEIGHBOURS = 20.0, 4
"""Distance to the fourth neighbour over its median, from which a Gaussian is alone."""
_TRIALS = 6  # of a bisection
Tell = Callable[[str], None]


def by_shape(gaussians: Gaussians, opacities: Tensor) -> dict[str, Tensor]:
    """Return (N,) bool by kind: what scales, opacities (N,) and distances alone say of
    Gaussians."""
    ordered = gaussians.scales.sort(dim=1, descending=True).values
    longest = ordered[:, 0]
    second = ordered[:, 1]
    return {
        "lone": lone(gaussians.means),
        "veils": (opacities < VEIL) & (longest > LARGE * longest.median()),
        "faint": opacities < FAINT,
        "needles": longest > NEEDLE * second.clamp_min(torch.finfo(second.dtype).tiny),
    }


def lone(means: Tensor) -> Tensor:
    """Return (N,) bool: whose fourth neighbour is ``LONE`` times as far as that of most Gaussians
    (N, 3)."""
    from scipy.spatial import KDTree

    if len(means) <= NEIGHBOURS:
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    points = means.double().cpu().numpy()
    distance = torch.from_numpy(
        np.asarray(KDTree(points).query(points, k=NEIGHBOURS + 1)[0])[:, -1]
    )
    return (distance > LONE * distance.median()).to(means.device)


def cleaned_file(gaussians: Gaussians, tell: Tell) -> Tensor:
    """Return (N,) bool which Gaussians stay of a scene without cameras: all but what is faint, a
    needle or alone."""
    found = by_shape(gaussians, gaussians.opacities)
    gone = torch.zeros_like(found["faint"])
    for kind in ("faint", "needles", "lone"):
        tell(f"clean: {kind}: {counted(int((found[kind] & ~gone).sum()), 'Gaussian')}")
        gone |= found[kind]
    if bool(gone.all()):
        raise DyngsError(
            "--clean: nothing would be left; this scene consists of needles, or of what hardly shows"
        )
    tell(
        f"clean: {int(gone.sum()):,} of {counted(len(gone), 'Gaussian')} go; without the cameras of a run neither what "
        "no camera saw nor what this costs can be measured"
    )
    return ~gone


def cleaned_run(
    run_dir: Path, max_loss: float, threads: int, data_root: Path | None, tell: Tell
) -> Tensor:
    """Return (N,) bool which Gaussians of a run stay; what goes, and what it costs, is told.

    One kind after another goes, of each as much as the mean PSNR of views held out may lose: by no
    more than ``max_loss`` in all, dB, and that of 16 training views by no more. Views held out are
    those of the split val, else every eighth training view, which then counts for no contribution.
    Deterministic. Raises DyngsError: no such run, or its capture cannot be read.
    """
    config = load_resolved(run_dir, data_root=data_root)
    if capability(config.model, HasGaussians) is None:
        raise DyngsError(f"{run_dir}: model.kind={config.model.kind} has no Gaussians to clean")
    with (
        kernel_threads(threads or num_cores()),
        deterministic(device_for(config.run.device), True),
        torch.no_grad(),
    ):
        trainer = at_end(config, run_dir)
        unseen = unseen_images(trainer)
        held = () if unseen else evenly_held_out(len(trainer.images))
        if not unseen and not held:
            raise DyngsError(
                f"{run_dir}: --clean needs two views or more, of which one judges what it costs"
            )
        images = unseen or [trainer.images[i] for i in held]
        scene: GaussianScene = trainer.model.scene.unmasked()
        before = quality_of(trainer, scene, images)
        trained_before = quality_of(trainer, scene)

        def losses(kept: Tensor) -> tuple[float, float]:
            """Return the losses of mean PSNR, dB: of the views held out, and of 16 training views
            as well, because few views may be kind by chance."""
            left = scene.select(kept)
            loss = before - quality_of(trainer, left, images)
            return loss, max(loss, trained_before - quality_of(trainer, left))

        kept = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
        for kind, rows in suspects_of(trainer, held).items():
            kept = taken(kept, kind, rows, lambda left: losses(left)[1] <= max_loss, tell)
        loss, worst = losses(kept)
        views = counted(len(images), "validation view" if unseen else "training view")
        gone = f"clean: {int((~kept).sum()):,} of {counted(len(kept), 'Gaussian')} go"
        cost = f"{before:.2f} -> {before - loss:.2f} dB ({-loss:+.3f}) on {views} held out"
        tell(f"{gone}; {cost}; {max(worst, 0):.3f} of {max_loss:g} dB lost, with training views")
        return kept.cpu()


def taken(
    kept: Tensor, kind: str, rows: Tensor, may_stay: Callable[[Tensor], bool], tell: Tell
) -> Tensor:
    """Return (N,) bool: ``kept`` without the first of ``rows`` (K,), all or as many as bisection
    finds."""
    rows = rows[kept[rows]]
    low = 0
    high = count = len(rows)
    trials = 0
    left = kept
    while count > low and trials <= _TRIALS:
        trials += 1
        tried = kept.clone()
        tried[rows[:count]] = False
        if bool(tried.any()) and may_stay(tried):
            low = count
            left = tried
        else:
            high = count
        count = (low + high) // 2
    if len(rows):
        tell(f"clean: {kind}: {low:,} of {counted(len(rows), 'Gaussian')} go")
    return left


def at_end(config: Config, run_dir: Path) -> GaussianTrainer:
    """Return the trainer of a run where it ended; without checkpoints with nothing but its
    scene."""
    run = load_run(run_dir, config.data.root)
    trainer: GaussianTrainer = assemble(
        config, read_capture_of(config.data, run.info), restored=True
    )
    if has_only_scene_file(run_dir):
        scene = run.scene.to(trainer.device)
        trainer.model.begin_with(scene, trainer.model.training)
        trainer.model.exchange(scene)
    else:
        trainer.restore(latest_checkpoint(run_dir))
    return trainer


def suspects_of(trainer: GaussianTrainer, held: Sequence[int]) -> dict[str, Tensor]:
    """Return the rows (K,) that may go, by kind, the most harmless first; of each first those that
    contribute least to all training views not ``held``."""
    scene: GaussianScene = trainer.model.scene.unmasked()
    views = scoring_views(trainer, scene)
    if scene.is_static:
        cameras = trainer.images.cameras()
        views = replace(views, cameras=[cameras[i] for i in range(len(cameras)) if i not in held])
    found = importance(views, slopes=False)
    contribution = found.contribution
    kinds = {"never seen": contribution <= 0}
    if scene.is_static and len(trainer.images) >= FEWEST_VIEWS:
        kinds["floaters"] = floaters(trainer)
    shapes = by_shape(scene.at(None), found.opacities.amax(0))
    kinds |= {kind: shapes[kind] for kind in ("lone", "faint", "veils", "needles")}
    order = torch.sort(contribution, stable=True).indices
    return {kind: order[is_one[order]] for kind, is_one in kinds.items()}
