"""A guessed focal length: found where perspective shows it."""

import torch

from dyngs.camera import Cameras
from dyngs.human.fit.lens_fit import fit_lens, num_ticks
from dyngs.human.fit.silhouettes import ObservedFrame, Surface, surface_of
from dyngs.human.fit.solve import Fitting, drawn_frame, near_given, new_fit, with_lens
from dyngs.human.motion.clip import MotionClip
from dyngs.human.template.body_reader import default_template
from dyngs.human.template.joints import JOINT_NAMES

SIZE, FRAMES, STEPS, DISTANCE = 32, 4, 12, 2.2


def filmed(log_focal: float) -> tuple[Surface, MotionClip, list[ObservedFrame]]:
    """Who turns before a camera whose focal length is not the guessed one, by that logarithm."""
    surface = surface_of(default_template(), 16)
    intrinsics = torch.tensor([[0.9 * SIZE, 0, SIZE / 2], [0, 0.9 * SIZE, SIZE / 2], [0, 0, 1]])
    camera = Cameras(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None], intrinsics[None], SIZE, SIZE)
    poses = torch.zeros(FRAMES, 55, 3)
    poses[:, 0, 1] = torch.arange(FRAMES) * 0.7
    poses[:, JOINT_NAMES.index("left_shoulder"), 1] = -1.2
    trans = torch.tensor([0.0, 0.0, -DISTANCE]).repeat(FRAMES, 1)
    times = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    clip = MotionClip(times, poses, trans, torch.ones(FRAMES))
    true = with_lens(new_fit(clip, surface), DISTANCE)
    with torch.no_grad():
        true["log_focal"].add_(log_focal)
        known = torch.ones(1, SIZE, SIZE)
        seen = [ObservedFrame(camera, drawn_frame(true, clip, surface, row, camera), known) for row in range(FRAMES)]
    return surface, clip, seen


def test_a_wrong_guess_is_corrected() -> None:
    surface, clip, seen = filmed(-0.3)
    ticks: list[int] = []
    start = new_fit(clip, surface)
    fitting = Fitting(clip, surface, near_given(clip))
    found, lens = fit_lens(fitting, start, (), seen.__getitem__, STEPS, lambda: ticks.append(1))
    assert lens.taken
    assert lens.error[1] < 0.8 * lens.error[0]
    assert 0.6 < lens.factor < 0.93
    assert float(found["log_focal"].detach().exp()) == lens.factor
    assert len(ticks) == num_ticks(STEPS)
    assert "taken" in lens.summary()
    assert float(start["poses"].detach().abs().max()) == 0


def test_where_the_guess_stays_nothing_is_fitted_again() -> None:
    surface, clip, seen = filmed(0.0)
    start = new_fit(clip, surface)
    found, lens = fit_lens(Fitting(clip, surface, near_given(clip)), start, (), seen.__getitem__, STEPS)
    assert not lens.taken
    assert found is start
    assert "the guess stays" in lens.summary()
