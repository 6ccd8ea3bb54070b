"""``dyngs.compat.DefaultStrategy`` and ``MCMCStrategy``: gsplat's calls on a user's tensors."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import torch
from scenes import random_scene
from torch import Tensor, nn

import dyngs.compat as gsplat
from dyngs.core.errors import DyngsError

pytestmark = pytest.mark.usefixtures("one_thread")


class UserLoop:
    """A training loop as gsplat's documentation has it, of 60 Gaussians and two views."""

    def __init__(self, strategy: Any, packed: bool = False, lr: float = 1e-3) -> None:
        torch.manual_seed(0)
        self.strategy = strategy
        self.packed = packed
        self.scene = scene = random_scene(n=60, views=2, seed=8, degree=0)
        values = {
            "means": scene.means,
            "scales": scene.scales.log(),
            "quats": scene.quats,
            "opacities": torch.logit(scene.opacities),
            "sh0": scene.sh,
            "label": torch.arange(60.0)[:, None],
        }
        self.params = nn.ParameterDict({k: nn.Parameter(v.float()) for k, v in values.items()})
        self.params["label"].requires_grad_(False)
        self.optimizers = {
            name: torch.optim.Adam([x], lr=lr) for name, x in self.params.items() if x.requires_grad
        }
        strategy.check_sanity(self.params, self.optimizers)
        self.state = strategy.initialize_state()

    def render(self, packed: bool) -> tuple[Tensor, dict[str, Any]]:
        p = self.params
        image, _, info = gsplat.rasterization(
            p["means"],
            p["quats"],
            p["scales"].exp(),
            p["opacities"].sigmoid(),
            p["sh0"],
            self.scene.cam_from_world.float(),
            self.scene.intrinsics.float(),
            self.scene.width,
            self.scene.height,
            sh_degree=0,
            packed=packed,
        )
        return image, info

    def run(self, steps: range) -> None:
        for step in steps:
            image, info = self.render(self.packed)
            which: tuple[Any, ...] = (self.params, self.optimizers, self.state, step, info)
            self.strategy.step_pre_backward(*which)
            image.square().mean().backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            if isinstance(self.strategy, gsplat.MCMCStrategy):
                self.strategy.step_post_backward(*which, lr=1e-4)
            else:
                self.strategy.step_post_backward(*which, packed=self.packed)

    def check_rows(self) -> int:
        """Every tensor of the loop has one row per Gaussian, and the optimizers hold them."""
        count = len(self.params["means"])
        for name, x in self.params.items():
            assert len(x) == count
            if name in self.optimizers:
                optimizer = self.optimizers[name]
                assert optimizer.param_groups[0]["params"][0] is x
                assert list(optimizer.state) == [x]
                assert optimizer.state[x]["exp_avg"].shape == x.shape
        return count


def test_fields_and_calls_are_those_of_gsplat() -> None:
    """Of gsplat 1.5.3, in its order."""
    assert " ".join(inspect.signature(gsplat.MCMCStrategy).parameters) == (
        "cap_max noise_lr refine_start_iter refine_stop_iter refine_every min_opacity verbose"
    )
    fields = " ".join(inspect.signature(gsplat.strategy.DefaultStrategy).parameters)
    assert fields == (
        "prune_opa grow_grad2d grow_scale3d grow_scale2d prune_scale3d prune_scale2d "
        "refine_scale2d_stop_iter refine_start_iter refine_stop_iter reset_every refine_every "
        "pause_refine_after_reset absgrad revised_opacity verbose"
    )
    assert gsplat.rendering.rasterization is gsplat.rasterization


@pytest.mark.parametrize("packed", [True, False])
def test_gradients_are_averaged_over_the_views_that_see_a_gaussian(packed: bool) -> None:
    strategy = gsplat.DefaultStrategy(refine_start_iter=100)
    loop = UserLoop(strategy, packed)
    loop.run(range(1))
    dense = UserLoop(strategy)
    image, info = dense.render(packed=False)
    info["means2d"].retain_grad()
    image.square().mean().backward()
    seen = (info["radii"] > 0).all(-1)
    # 2D gradients in units of half the image, times the number of views that share the loss
    scale = torch.tensor([dense.scene.width, dense.scene.height]) / 2 * 2
    lengths = (info["means2d"].grad * scale).norm(dim=-1)
    assert loop.state["count"].tolist() == seen.sum(0).tolist()
    torch.testing.assert_close(loop.state["grad2d"], (lengths * seen).sum(0))


def test_small_gaussians_are_cloned_large_ones_split_and_faint_ones_pruned() -> None:
    strategy = gsplat.DefaultStrategy(grow_grad2d=0.0, refine_start_iter=0, refine_every=2)
    loop = UserLoop(strategy)
    extent = loop.params["scales"].exp().amax(1).median().item() / strategy.grow_scale3d
    loop.state = strategy.initialize_state(scene_scale=extent)
    with torch.no_grad():
        loop.params["opacities"][:5] = -9.0
    before = {name: x.detach().clone() for name, x in loop.params.items()}
    loop.run(range(1, 3))
    label = loop.params["label"][:, 0].long()
    assert loop.check_rows() == len(label)
    counts = torch.bincount(label, minlength=60)
    large = before["scales"].exp().amax(1) > 0.01 * extent
    assert counts.tolist() == [0] * 5 + [2] * 55
    scales = loop.params["scales"].exp()
    shrunk = scales.amax(1) < 0.8 * before["scales"].exp().amax(1)[label]
    assert shrunk.tolist() == large[label].tolist()
    assert loop.state["scene_scale"] == extent
    loop.run(range(3, 4))  # sums begin anew for the new rows
    assert len(loop.state["grad2d"]) == len(label)


def test_opacities_are_reset_and_their_moments_cleared() -> None:
    strategy = gsplat.DefaultStrategy(prune_opa=0.02, reset_every=3)
    loop = UserLoop(strategy)
    loop.run(range(1, 4))
    opacities = loop.params["opacities"]
    assert opacities.sigmoid().max().item() == pytest.approx(0.04)
    assert not loop.optimizers["opacities"].state[opacities]["exp_avg"].any()
    assert loop.check_rows() == 60


def test_refinement_pauses_after_a_reset_and_ends() -> None:
    options = {"grow_grad2d": 0.0, "refine_start_iter": 0, "refine_every": 1, "reset_every": 4}
    paused = UserLoop(gsplat.DefaultStrategy(**options, pause_refine_after_reset=3))
    paused.run(range(1, 3))
    assert len(paused.params["means"]) == 60
    paused.run(range(3, 4))
    count = paused.check_rows()
    assert count > 60
    stopped = UserLoop(gsplat.DefaultStrategy(**options, refine_stop_iter=1))
    stopped.run(range(1, 6))
    assert len(stopped.params["means"]) == 60


def test_mcmc_relocates_faint_gaussians_and_grows_to_its_cap() -> None:
    strategy = gsplat.MCMCStrategy(cap_max=62, refine_start_iter=0, refine_every=2, noise_lr=0.0)
    loop = UserLoop(strategy, lr=0.0)
    with torch.no_grad():
        loop.params["opacities"][:5] = -9.0
    before = loop.params["means"].detach().clone()
    loop.run(range(1, 3))
    assert loop.check_rows() == 62
    assert loop.params["opacities"].sigmoid().min() >= strategy.min_opacity
    label = loop.params["label"][:, 0].long()
    assert label.min() >= 5
    assert torch.equal(loop.params["means"], before[label])


def test_mcmc_noise_moves_faint_gaussians_and_follows_the_seed() -> None:
    first, second = (UserLoop(gsplat.MCMCStrategy(noise_lr=1e3), lr=0.0) for _ in range(2))
    moved = []
    for loop in (first, second):
        torch.manual_seed(3)
        with torch.no_grad():
            loop.params["opacities"][:30] = -9.0
            loop.params["opacities"][30:] = 9.0
        before = loop.params["means"].detach().clone()
        loop.run(range(1))
        moved.append(loop.params["means"].detach() - before)
    assert torch.equal(moved[0], moved[1])
    assert moved[0][:30].any()
    assert not moved[0][30:].any()


def test_opacities_may_have_a_second_axis() -> None:
    strategy = gsplat.MCMCStrategy(cap_max=62, refine_start_iter=0, refine_every=1)
    loop = UserLoop(strategy)
    column = nn.Parameter(loop.params["opacities"].detach()[:, None])
    loop.params["opacities"] = column
    optimizers = loop.optimizers | {"opacities": torch.optim.Adam([column])}
    strategy.check_sanity(loop.params, optimizers)
    strategy.step_post_backward(loop.params, optimizers, loop.state, 1, {}, lr=1e-4)
    assert loop.params["opacities"].shape == (62, 1)


def test_wrong_parameters_and_options_are_refused_in_one_line() -> None:
    loop = UserLoop(gsplat.DefaultStrategy())
    strategy = loop.strategy
    without = {name: x for name, x in loop.params.items() if name != "quats"}
    with pytest.raises(DyngsError, match="quats missing"):
        strategy.check_sanity(without, loop.optimizers)
    shared = loop.optimizers | {"sh0": torch.optim.Adam([loop.params["means"]])}
    with pytest.raises(DyngsError, match=r"optimizers\['sh0'\]"):
        strategy.check_sanity(loop.params, shared)
    with pytest.raises(DyngsError, match="revised_opacity"):
        gsplat.DefaultStrategy(revised_opacity=True)
