"""The static model: parameters pass through, or filtered with what the cameras can resolve."""

from __future__ import annotations

import torch

from dyngs.camera import Cameras
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.static.filters import filter_std, fuse_filter
from dyngs.static.training import StaticScene

INTRINSICS = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])


def _gaussians(z: float, n: int = 3) -> Gaussians:
    means = torch.zeros(n, 3)
    means[:, 2] = z
    return Gaussians(means, torch.ones(n, 4), torch.full((n, 3), -3.0), torch.zeros(n), torch.zeros(n, 1, 3))


def _camera() -> Cameras:
    return Cameras(torch.eye(4)[None], INTRINSICS[None], 100, 100)


def test_without_filter_parameters_pass_through() -> None:
    model, gaussians = StaticScene(), _gaussians(2.0)
    drawn = model.gaussians_at(gaussians, None, 1)
    assert drawn.gaussians is gaussians
    assert drawn.penalties == {}
    assert model.after_step(gaussians, 1, EditResult(None)) == 0
    assert model.state() == {}


def test_nothing_depends_on_time() -> None:
    model = StaticScene()
    assert all(model.trains_on(time, step) for time in (None, 0.0, 1.0) for step in (1, 1000))
    assert model.num_moving(7) == 0


def test_the_set_is_left_to_the_strategy() -> None:
    assert all(StaticScene().edit(_gaussians(2.0), step) is None for step in (1, 2, 100))


def test_the_filter_is_kept_until_it_is_due() -> None:
    model = StaticScene([_camera()], range(100, 200, 100))
    near, far = _gaussians(2.0), _gaussians(4.0)
    with_near, with_far = (fuse_filter(far, filter_std(x.means, [_camera()])) for x in (near, far))

    def drawn(gaussians: Gaussians) -> Gaussians:
        return model.gaussians_at(gaussians, None, 1).gaussians

    drawn(near)
    model.after_step(far, 50, None)
    assert torch.equal(drawn(far).log_scales, with_near.log_scales)
    model.after_step(far, 100, None)
    assert torch.equal(drawn(far).log_scales, with_far.log_scales)
    model.after_step(near, 101, EditResult(TopologyEdit.select(torch.ones(3, dtype=torch.bool))))
    assert torch.equal(drawn(far).log_scales, with_near.log_scales)
    model.after_step(far, 102, EditResult(None))  # opacities were reset: where cameras look may have changed
    assert torch.equal(drawn(far).log_scales, with_far.log_scales)


def test_state_goes_round() -> None:
    first, second = StaticScene([_camera()]), StaticScene([_camera()])
    drawn = first.gaussians_at(_gaussians(2.0), None, 1).gaussians
    second.load_state(first.state())
    assert torch.equal(second.gaussians_at(_gaussians(4.0), None, 1).gaussians.log_scales[0], drawn.log_scales[0])
