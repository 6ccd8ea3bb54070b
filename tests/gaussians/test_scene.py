"""Scene interface: stored, edited, split and moved scenes render the same images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_kinds import KINDS, onlooker, restored, scene_of_kind
from tiny_fields import ALL_KINDS as FIELDS
from tiny_fields import busy_config, write_tiny_capture
from torch import Tensor

from dyngs.config import FixedStrategy
from dyngs.core.state import Role, select_prefix, strip_roles
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import restore_colour_network
from dyngs.gaussians.scene import GaussianScene, restore_scene
from dyngs.human.avatar.scene import HumanScene
from dyngs.models.static_section import StaticModel
from dyngs.training.new_trainer import build_trainer

TIMES = (None, 0.0, 0.37, 0.5, 1.0)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def assert_alike(found: Gaussians, expected: Gaussians, atol: float = 1e-6) -> None:
    for name, x in expected.tensors().items():
        # rtol: two units in the last place, for quaternions, which are not of unit length
        torch.testing.assert_close(
            getattr(found, name), x, rtol=2.4e-7, atol=atol, msg=lambda m, name=name: f"{name}: {m}"
        )


def image(scene: GaussianScene, time: float | None) -> Tensor:
    with torch.no_grad():
        return scene.render(onlooker(), time).rgb


def names_with(scene: GaussianScene, role: Role) -> set[str]:
    return {name for name, x in scene.state().items() if x.role is role}


def leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(
        **{name: x.detach().clone().requires_grad_() for name, x in gaussians.tensors().items()}
    )


# --- what is stored
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawing", [False, True], ids=["state", "drawing state"])
def test_restored_scene_renders_equal_images(kind: str, drawing: bool) -> None:
    """Bitwise, except for skinning weights, which are stored with their corrections applied."""
    scene = scene_of_kind(kind)
    state = scene.drawing_state() if drawing else scene.state()
    found = replace(
        restored(kind, state),
        colour=restore_colour_network(select_prefix(strip_roles(state), "model.colour")),
    )
    assert type(found) is type(scene)
    assert found.times == scene.times
    assert torch.equal(found.rows, scene.rows)
    for time in TIMES:
        atol = 1e-5 if drawing and kind in ("human", "gaussians_4d") else 0.0
        torch.testing.assert_close(image(found, time), image(scene, time), rtol=0, atol=atol)
    assert float(image(scene, 0.37).std()) > 0.01, "something is seen"


def test_every_tensor_has_a_role_and_its_rows(kind: str) -> None:
    """Before and after an edit."""
    scene = scene_of_kind(kind)
    copied = TopologyEdit(
        torch.tensor([8, 1, 1, 5, 0]), torch.tensor([False, False, True, False, False])
    )
    for one in (scene, scene.apply_edit(copied), scene.part("moving"), scene.part("static")):
        for name, x in one.state().items():
            assert isinstance(x.role, Role), name
            if x.role is Role.PER_GAUSSIAN:
                assert len(x.tensor) == len(one), name
            if x.role is Role.PER_MOVING:
                assert len(x.tensor) == one.num_moving, name
    assert {f"gaussians.{name}" for name in scene.gaussians.tensors()} <= names_with(
        scene, Role.PER_GAUSSIAN
    )
    assert (kind in ("control_nodes", "windowed", "free", "gaussians_4d")) == bool(
        names_with(scene, Role.PER_MOVING)
    )
    assert (
        scene.drawing_state().keys()
        == scene.state().keys() - names_with(scene, Role.TRAINING) - WITHIN_OTHERS
    )
    assert all(not x.tensor.requires_grad for x in scene.state().values())


WITHIN_OTHERS = {"model.learned.weights"}
"""Stored within other tensors where a scene is stored for drawing alone."""


# --- parts
# -------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from(KINDS),
    st.lists(st.tuples(st.integers(0, 8), st.booleans()), max_size=14),
    st.sampled_from(TIMES),
)
def test_edited_scene_renders_copies(
    kind: str, rows: list[tuple[int, bool]], time: float | None
) -> None:
    scene = scene_of_kind(kind)
    source = torch.tensor([row for row, _ in rows], dtype=torch.long)
    before = scene.at(time)
    # new free primitives are shifted in time on purpose
    is_new = torch.tensor([new and kind != "free" for _, new in rows], dtype=torch.bool)
    edited = scene.apply_edit(TopologyEdit(source, is_new))
    assert len(edited) == len(rows)
    assert edited.times == scene.times
    assert_alike(edited.without_masks().at(time), scene.without_masks().at(time).select(source))
    if scene.masks is not None and not edited.is_static:
        seen = torch.isin(source, scene.masks.active(scene.masks.interval(time or 0.0)))
        assert_alike(edited.at(time), scene.without_masks().at(time).select(source[seen]))
    assert_alike(scene.at(time), before, atol=0.0)


def test_moving_and_static_parts_make_the_scene(kind: str) -> None:
    scene = scene_of_kind(kind)
    moving = scene.part("moving")
    still = scene.part("static")
    moves = torch.zeros(len(scene), dtype=torch.bool)
    moves[scene.rows] = True
    assert (len(moving), len(still)) == (int(moves.sum()), int((~moves).sum()))
    assert moving.moving_fraction == (1.0 if len(moving) else 0.0)
    assert still.moving_fraction == 0.0
    for time in TIMES:
        whole = scene.without_masks().at(time)
        assert_alike(moving.at(time), whole.select(moves))
        assert_alike(still.at(time), whole.select(~moves))


# --- times
# -------------------------------------------------------------------------------------------------


# --- drawing
# -------------------------------------------------------------------------------------------------


def test_cache_is_cleared_after_in_place_changes(kind: str) -> None:
    """Parameters are updated in place between two renderings."""
    scene = scene_of_kind(kind)
    scene.at(0.37)
    scene.gaussians.means.data += 0.25
    if isinstance(scene, HumanScene):
        scene.learned["weights"].data += torch.arange(float(scene.learned["weights"].shape[1]))
    scene.clear_caches()
    assert_alike(scene.at(0.37), restored(kind, scene.state()).at(0.37), atol=0.0)


# --- devices
# -------------------------------------------------------------------------------------------------


def test_scene_tensors_move_to_a_device(kind: str) -> None:
    """The meta device stands in for a GPU. Tensors that are read by the host stay on the CPU."""
    moved = scene_of_kind(kind).to("meta")
    on_cpu = {name for name, x in moved.state().items() if x.tensor.device.type == "cpu"}
    assert on_cpu <= {
        *(
            "model.times",
            "model.clip.times",
            "model.parents",
            "model.field.numbers",
            "model.colour.sees",
        ),
        *("model.masks.times", "model.masks.count"),
    }
    assert all(
        x.tensor.device.type == "meta" for name, x in moved.state().items() if name not in on_cpu
    )
    assert moved.rows.device.type == "meta"


# --- training
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["static", *FIELDS])
def test_loaded_scene_equals_trained_scene(model: str, tmp_path: Path) -> None:
    """Same class, same image."""
    capture = write_tiny_capture(tmp_path / "capture")
    config = busy_config(capture, tmp_path, "mlp" if model == "static" else model, filter_3d=True)
    # At twice the rates, the static model of `free` explains these images before motion begins.
    optim = config.optim.model_copy(update={"rate_factor": 1.0})
    config = config.model_copy(update={"strategy": FixedStrategy(), "optim": optim})
    if model == "static":
        config = config.model_copy(update={"model": StaticModel(sh_degree=1)})
    trainer = build_trainer(config)
    for _ in range(11):
        trainer.step()
    loaded = restore_scene(trainer.checkpoint(), config.model)
    assert type(loaded) is type(trainer.model.scene)
    assert loaded.moving_fraction == trainer.model.scene.moving_fraction
    assert (loaded.moving_fraction > 0) == (model != "static")
    assert loaded.options == trainer.model.scene.options
    view = trainer.images[0]
    behind = trainer.model.scene.background
    for time in (0.0, 0.37):
        with torch.no_grad():
            drawn = [
                scene.render(view.cameras, time, background=behind).rgb
                for scene in (loaded, trainer.model.scene)
            ]
        assert torch.equal(*drawn)
        in_training = trainer.model.training.time_step(
            trainer.model.scene, replace(view, time=time), config.train.steps
        )
        assert_alike(in_training.gaussians.detach(), loaded.at(time))
