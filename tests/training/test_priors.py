from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import pytest
import torch
from moving_scene import MOVING_ROWS, SETUP, Sliding, camera, row_of_balls
from tiny_priors import with_priors

from dyngs.config.io import load_config
from dyngs.core.errors import DyngsError
from dyngs.data.loader import Image
from dyngs.data.read import read_capture
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.models.model import LossInput, Model, RenderOutput
from dyngs.training.priors import (
    PointTracks,
    PriorLosses,
    TimedCamera,
    depth_error,
    load_priors,
    render_displacements,
    track_error,
)

HERE = camera(32, 24)
GENERATOR = torch.Generator().manual_seed(0)


def found(root: Path, *changes: str, moves: bool = True) -> PriorLosses:
    config = load_config("dynamic", [f"data.root={root}", "data.test_every=0", *changes])
    capture = read_capture(config.data)
    return load_priors(config, capture, capture.splits["train"], moves=moves)


def test_priors_of_a_capture_are_used(tmp_path: Path) -> None:
    priors = found(with_priors(tmp_path))
    assert priors.depth
    assert priors.masks
    assert set(priors.flow_to) == {1, 2}
    assert priors.tracks is not None
    assert priors.message.endswith("depth maps, optical flow, tracks, motion masks")


def test_priors_that_are_not_requested_are_not_read(tmp_path: Path) -> None:
    with_priors(tmp_path)
    (tmp_path / "tracks.npz").write_bytes(b"")
    assert found(tmp_path, "train.priors=[]") == PriorLosses()
    assert found(tmp_path, "train.priors=[depth]").message.endswith(": depth maps")


def test_still_scenes_use_depth_alone(tmp_path: Path) -> None:
    assert found(with_priors(tmp_path), moves=False).message.endswith(": depth maps")


def test_tracks_of_other_images_are_refused(tmp_path: Path) -> None:
    root = with_priors(tmp_path)
    arrays = dict(np.load(root / "tracks.npz"))
    arrays["names"] = np.array([f"other/{i}.png" for i in range(len(arrays["names"]))])
    np.savez(root / "tracks.npz", **arrays)
    with pytest.raises(DyngsError, match=r"tracks.npz: 'names' holds no training view, such as"):
        found(root)


def scene(speed: float) -> DynamicScene:
    gaussians = row_of_balls()
    gaussians = gaussians.replace(means=gaussians.means.clone().requires_grad_())
    field = Sliding(speed=speed, setup=SETUP)
    return DynamicScene(
        gaussians=gaussians,
        training_times=(0.0, 1.0),
        field=field,
        moving=torch.tensor(MOVING_ROWS),
    )


def image(**maps: torch.Tensor) -> Image:
    return Image("a", HERE, torch.zeros(24, 32, 3), None, None, 0.0, **maps)


class Seen:
    """A model of which times up to ``until`` are trained on."""

    def __init__(self, scene: DynamicScene, until: float) -> None:
        self.scene, self._until = scene, until

    def window(self, step: int) -> tuple[float, float]:
        return 0.0, self._until


def terms(
    priors: PriorLosses, own: Image, *, until: float = 1.0, speed: float = 0.5
) -> dict[str, float]:
    of = scene(speed)
    depth: Literal["none", "expected"] = "expected" if priors.needs_depth(own) else "none"
    rendering = of.render(HERE, 0.0, options=RenderOptions(nonfinite="trust", depth=depth))
    rgb = rendering.rgb[0]
    model = cast(Model[Any], Seen(of, until))
    look = LossInput(0, 1, own, RenderOutput(rendering), rgb, rgb, model, GENERATOR)
    return {name: float(x.detach()) for name, x in priors(look).items()}


def test_zero_flow_penalizes_motion() -> None:
    """Zero flow costs nothing at speed 0 and has a loss at another speed."""
    own = image(flow=torch.zeros(24, 32, 2))
    priors = PriorLosses(flow_to={0: TimedCamera(HERE, 0.5)})
    assert terms(priors, own, speed=0.0)["flow"] < 1e-6
    assert terms(priors, own)["flow"] > 0.001
    assert terms(priors, own, until=0.4) == {}


def test_depth_is_drawn_only_where_it_is_needed() -> None:
    own = image(depth=torch.ones(24, 32))
    assert not PriorLosses().needs_depth(own)
    assert not PriorLosses(depth=True).needs_depth(image())
    assert PriorLosses(depth=True).needs_depth(own)


def test_tracks_pair_views_of_other_times_that_share_points() -> None:
    xy = torch.zeros(4, 5, 2)
    visible = torch.ones(4, 5, dtype=torch.bool)
    visible[1, :3] = False
    tracks = PointTracks(xy, visible, [TimedCamera(HERE, time) for time in (0.0, 0.25, 0.5, 0.0)])
    found = [tracks.pair(0, lambda _: True, GENERATOR) for _ in range(8)]
    assert {None if pair is None else pair[0].time for pair in found} == {0.5}
    assert tracks.pair(0, lambda time: time < 0.4, GENERATOR) is None


def true_depth() -> torch.Tensor:
    y, x = torch.meshgrid(torch.linspace(0, 1, 12), torch.linspace(0, 1, 16), indexing="ij")
    return 2 + x + 0.5 * y + (x > 0.5)


@pytest.mark.parametrize("kind", ["sensor", "network"])
def test_maps_are_aligned_with_the_drawn_depth(kind: str) -> None:
    """A map of another unit, or affine in the true inverse depth, has no error."""
    depth = true_depth()
    given = 0.3 * depth if kind == "sensor" else 1 / (0.5 / depth + 0.1)
    error = depth_error(depth, torch.ones_like(depth), given)
    assert error is not None
    assert float(error) < 1e-5


def test_a_step_against_the_gradient_brings_a_wrong_depth_nearer() -> None:
    truth = true_depth()
    drawn = truth.clone()
    drawn[3:6, 3:6] += 0.5
    drawn.requires_grad_()
    error = depth_error(drawn, torch.ones_like(drawn), 0.3 * truth)
    assert error is not None
    (slope,) = torch.autograd.grad(error, drawn)
    assert bool((slope[3:6, 3:6] > 0).all())


def test_unknown_transparent_and_masked_pixels_do_not_count() -> None:
    depth = true_depth()
    alpha = torch.ones(12, 16)
    mask = torch.ones(12, 16)
    given = depth.clone()
    given[0] = 0
    spoiled = depth.clone()
    spoiled[:3] = 90
    alpha[1], mask[2] = 0.2, 0
    error = depth_error(spoiled, alpha, given, mask)
    assert error is not None
    assert float(error) < 1e-5
    assert depth_error(depth, torch.zeros(12, 16), given) is None


def test_displacements_of_the_visible_gaussian_are_rendered() -> None:
    """One ball moves along x at the depth of its centre: focal length times motion over depth."""
    here = camera(32, 24)
    start = row_of_balls(1)
    moved = start.replace(means=start.means + torch.tensor([0.1, 0.0, 0.0]))
    drawn = render_displacements(start, moved, here, here, RenderOptions())
    pose = here.cam_from_world[0]
    before, after = (x.means[0] @ pose[:3, :3].T + pose[:3, 3] for x in (start, moved))
    focal = here.intrinsics[0].diagonal()[:2]
    wanted = focal * (after[:2] / after[2] - before[:2] / before[2])
    shown = drawn[..., 2] > 0.5
    assert bool(shown.any())
    torch.testing.assert_close(
        drawn[shown][:, :2], wanted.expand(int(shown.sum()), 2), rtol=0, atol=1e-3
    )


def test_tracks_are_right_where_the_points_go() -> None:
    drawn = torch.zeros(24, 32, 3)
    drawn[..., 2] = 1
    drawn[:, 16:, 0] = 4
    start = torch.tensor([[20.0, 5.0], [4.0, 7.0]])
    exact = track_error(drawn, start, torch.tensor([[24.0, 5.0], [4.0, 7.0]]))
    wrong = track_error(drawn, start, start)
    assert exact is not None
    assert wrong is not None
    assert float(exact) == 0
    assert float(wrong) > 0.04
    assert track_error(torch.zeros(24, 32, 3), start, start) is None
