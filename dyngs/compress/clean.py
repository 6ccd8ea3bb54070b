"""Removal of floaters, faint and unseen Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.compress.search import held_out_indices, validation_images
from dyngs.compress.stage import mean_psnr, measure_contributions, scoring_views
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, format_count
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import depths_and_contributions
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.checkpoint import read_run_capture
from dyngs.models.kind import HasGaussians, capability, find_kind
from dyngs.ops.device import deterministic, select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.checkpoint import has_only_scene_file, latest_checkpoint, load_run
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import GaussianTrainer, build_trainer
from dyngs.training.trainer import Trainer, TrainingEdit

MAIN_FRACTION = 0.5  # Fraction of the weight of a Gaussian that must lie in one view
# Depth of a Gaussian in that view, over the median depth of the view, below which it is near
NEAR = 0.6
SEEN = 0.3  # Sum of weights over all views, px, from which a Gaussian shows at all
# Of the views that are drawn, px: what hangs in the way shows in small ones, too
LONGEST_SIDE = 200
SOLID = 0.5  # Alpha from which a pixel has a depth
FEWEST_VIEWS, MOST = 20, 0.01
"""With fewer views, or with a larger fraction of such Gaussians, much of the scene is seen by one
view only."""


def remove_floaters(loop: Loop) -> TrainingEdit | None:
    """Editor that removes floaters when training ends, if that is requested; static scenes only."""
    trainer = loop.trainer
    assert isinstance(trainer, Trainer)
    options = trainer.config.train
    if trainer.done != options.steps or not options.remove_floaters:
        return None
    is_still = "init.scene" in find_kind(trainer.config.model).uses
    if not is_still or len(trainer.images) < FEWEST_VIEWS:
        return None
    found = find_floaters(trainer)
    count = int(found.sum())
    if not count:
        return None
    before = format_count(len(found), "Gaussian")
    if count > MOST * len(found):
        return TrainingEdit(f"kept {count:,} of {before} close to cameras: too many for floaters")
    return TrainingEdit(f"removed {format_count(count, 'floater')} of {before}", ~found)


@torch.no_grad()
def find_floaters(trainer: GaussianTrainer) -> Tensor:
    """Return (N,) bool which Gaussians of a static scene are floaters, by all of its training
    views."""
    gaussians = trainer.model.scene.gaussians.detach()
    total = torch.zeros_like(gaussians.logit_opacities)
    most = torch.zeros_like(gaussians.logit_opacities)
    nearness = torch.full_like(total, torch.inf)
    for camera in trainer.images.cameras():
        small = camera.scaled(min(1.0, LONGEST_SIDE / max(camera.width, camera.height)))
        drawn, weights = depths_and_contributions(gaussians, small, trainer.model.options)
        weight = weights[0]
        alpha = 1 - drawn.transmittance[0]
        is_solid = alpha > SOLID
        depths = drawn.color[0, ..., 0][is_solid] / alpha[is_solid]
        pose = small.cam_from_world[0]
        depth = depths.median() if depths.numel() else depths.new_zeros(())
        is_main = weight > most
        nearness = torch.where(
            is_main, (gaussians.means @ pose[2, :3] + pose[2, 3]) / depth, nearness
        )
        total = total + weight
        most = torch.where(is_main, weight, most)
    return (total > SEEN) & (most > MAIN_FRACTION * total) & (nearness < NEAR)


NEEDLE = 20.0  # longest axis over the second longest
# opacity below which large Gaussians veil what is behind; size over the median size
VEIL, LARGE = 0.1, 4.0
FAINT = 2 / 255  # opacity below which a Gaussian hardly shows
LONE, NEIGHBOURS = 20.0, 4
"""Distance to the fourth neighbour over its median, from which a Gaussian is alone."""
_TRIALS = 6  # of a bisection
Tell = Callable[[str], None]


def classify_shapes(gaussians: Gaussians, opacities: Tensor) -> dict[str, Tensor]:
    """Return masks (N,) of suspicious Gaussians by kind, from scales, opacities and distances."""
    ordered = gaussians.scales.sort(dim=1, descending=True).values
    longest = ordered[:, 0]
    second = ordered[:, 1]
    return {
        "lone": find_isolated(gaussians.means),
        "veils": (opacities < VEIL) & (longest > LARGE * longest.median()),
        "faint": opacities < FAINT,
        "needles": longest > NEEDLE * second.clamp_min(torch.finfo(second.dtype).tiny),
    }


def find_isolated(means: Tensor) -> Tensor:
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


def clean_file(gaussians: Gaussians, tell: Tell) -> Tensor:
    """Return (N,) bool which Gaussians stay of a scene without cameras: all but what is faint, a
    needle or alone."""
    found = classify_shapes(gaussians, gaussians.opacities)
    gone = torch.zeros_like(found["faint"])
    for kind in ("faint", "needles", "lone"):
        tell(f"clean: {kind}: {format_count(int((found[kind] & ~gone).sum()), 'Gaussian')}")
        gone |= found[kind]
    if bool(gone.all()):
        raise DyngsError("--clean would remove all Gaussians; leave it out for this scene")
    tell(
        f"clean: {int(gone.sum()):,} of {format_count(len(gone), 'Gaussian')} go; without the "
        "cameras of a run neither what "
        "no camera saw nor what this costs can be measured"
    )
    return ~gone


def clean_run(
    run_dir: Path, max_loss: float, threads: int, data_root: Path | None, tell: Tell
) -> Tensor:
    """Return the mask (N,) of the Gaussians of a run to keep; logs removals and their cost.

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
        deterministic(select_device(config.run.device), True),
        torch.no_grad(),
    ):
        trainer = restore_final_trainer(config, run_dir)
        unseen = validation_images(trainer)
        held = () if unseen else held_out_indices(len(trainer.images))
        if not unseen and not held:
            raise DyngsError(
                f"{run_dir}: --clean needs two views or more, of which one judges what it costs"
            )
        images = unseen or [trainer.images[i] for i in held]
        scene: GaussianScene = trainer.model.scene.without_masks()
        before = mean_psnr(trainer, scene, images)
        trained_before = mean_psnr(trainer, scene)

        def losses(kept: Tensor) -> tuple[float, float]:
            """Return the losses of mean PSNR, dB: of the views held out, and of 16 training views
            as well, because few views may be kind by chance."""
            left = scene.select(kept)
            loss = before - mean_psnr(trainer, left, images)
            return loss, max(loss, trained_before - mean_psnr(trainer, left))

        kept = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
        for kind, rows in find_removal_candidates(trainer, held).items():
            kept = remove_within_loss(
                kept, kind, rows, lambda left: losses(left)[1] <= max_loss, tell
            )
        loss, worst = losses(kept)
        views = format_count(len(images), "validation view" if unseen else "training view")
        gone = f"clean: {int((~kept).sum()):,} of {format_count(len(kept), 'Gaussian')} go"
        cost = f"{before:.2f} -> {before - loss:.2f} dB ({-loss:+.3f}) on {views} held out"
        tell(f"{gone}; {cost}; {max(worst, 0):.3f} of {max_loss:g} dB lost, with training views")
        return kept.cpu()


def remove_within_loss(
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
        tell(f"clean: {kind}: {low:,} of {format_count(len(rows), 'Gaussian')} go")
    return left


def restore_final_trainer(config: Config, run_dir: Path) -> GaussianTrainer:
    """Return the trainer of a run where it ended; without checkpoints with nothing but its
    scene."""
    run = load_run(run_dir, config.data.root)
    trainer: GaussianTrainer = build_trainer(
        config, read_run_capture(config.data, run.info), restored=True
    )
    if has_only_scene_file(run_dir):
        scene = run.scene.to(trainer.device)
        trainer.model.start_from(scene, trainer.model.training)
        trainer.model.replace_scene(scene)
    else:
        trainer.restore(latest_checkpoint(run_dir))
    return trainer


def find_removal_candidates(trainer: GaussianTrainer, held: Sequence[int]) -> dict[str, Tensor]:
    """Return the rows (K,) that may go, by kind, the most harmless first; of each first those that
    contribute least to all training views not ``held``."""
    scene: GaussianScene = trainer.model.scene.without_masks()
    views = scoring_views(trainer, scene)
    if scene.is_static:
        cameras = trainer.images.cameras()
        unheld = [cameras[i] for i in range(len(cameras)) if i not in held]
        views = replace(views, cameras=[(None, unheld)])
    contribution = measure_contributions(views).sum(0)
    kinds = {"never seen": contribution <= 0}
    if scene.is_static and len(trainer.images) >= FEWEST_VIEWS:
        kinds["floaters"] = find_floaters(trainer)
    opacities = torch.stack([scene.at(time).opacities for time, _ in views.cameras])
    shapes = classify_shapes(scene.at(None), opacities.amax(0))
    kinds |= {kind: shapes[kind] for kind in ("lone", "faint", "veils", "needles")}
    order = torch.sort(contribution, stable=True).indices
    return {kind: order[is_one[order]] for kind, is_one in kinds.items()}
