"""A predicted field is drawn, stored, restored and not trained; broken files are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.core.state import strip_roles
from dyngs.human.predict.fields.keypoint_nerf import KeypointNerf
from dyngs.human.predict.fields.prediction import (
    NETWORKS,
    PredictedField,
    restore,
)
from dyngs.human.predict.kind import PredictedFieldModel
from dyngs.human.predict.people import Person, crop_source_images
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo, restore_model
from dyngs.models.renderable import DrawOptions

KINDS = sorted(NETWORKS)


@pytest.fixture(params=KINDS)
def scene(request: pytest.FixtureRequest, person: Person) -> PredictedField:
    body, scale = person.body_in(person.views[0])
    sources = crop_source_images([person.images[i] for i in (0, 2, 4)], scale)
    network = NETWORKS[request.param](torch.Generator().manual_seed(0), PredictedFieldModel())
    return PredictedField(network, sources, body, scale, background=torch.ones(3))


def kind_of(scene: PredictedField) -> Literal["keypoint_nerf", "eg_human_nerf"]:
    return "keypoint_nerf" if isinstance(scene.network, KeypointNerf) else "eg_human_nerf"


def checkpoint_of(scene: PredictedField, **changes: torch.Tensor) -> Checkpoint:
    tensors = strip_roles(scene.state()) | {f"field.{name}": x for name, x in changes.items()}
    return Checkpoint(
        CheckpointInfo(0, 1.0, (0.0, 0.0, 0.0), "white", "classic"), tensors, Path("it")
    )


def test_it_is_stored_and_drawn_the_same(scene: PredictedField, person: Person) -> None:
    model = PredictedFieldModel.model_validate({"network": kind_of(scene)})
    found = restore_model(checkpoint_of(scene), model)
    camera = person.images[1].cameras
    options = DrawOptions(depth="expected")
    one, other = (x.render(camera, 0.3, options=options) for x in (scene, found))
    assert torch.equal(one.rgb, other.rgb)
    assert torch.equal(one.transmittance, other.transmittance)
    assert one.depth is not None
    distance = float(camera.centers[0].norm())
    solid = one.alpha > 0.9
    assert bool(solid.any())
    assert bool(((one.depth[solid] - distance).abs() < 1.2 * scene.scale).all())
    low, high = scene.bounds
    assert bool((low < scene.scale * scene.body.key_points).all())
    assert bool((high > scene.scale * scene.body.key_points).all())
    assert bool((one.rgb[0, 0, 0] == 1).all()), "white beside the person"


def test_nothing_is_drawn_where_nobody_is(scene: PredictedField, person: Person) -> None:
    camera = person.images[1].cameras
    away = camera.intrinsics.clone()
    away[:, 0, 2] += 200
    assert bool((scene.render(replace(camera, intrinsics=away)).alpha == 0).all())
    behind = camera.cam_from_world.clone()
    behind[:, 2, 3] -= 100
    assert bool((scene.render(replace(camera, cam_from_world=behind)).alpha == 0).all())


@pytest.mark.parametrize(
    "name",
    ["numbers", "body.vertices", "body.faces", "sources.rgba", "network.encoder.fine.weight"],
)
def test_mismatched_tensors_are_refused(scene: PredictedField, name: str) -> None:
    whole = checkpoint_of(scene)
    own = whole.tensors[f"field.{name}"]
    broken = own + 10**9 if name == "body.faces" else own[..., :-1]
    for changed in (broken, own * float("nan") if own.is_floating_point() else broken):
        with pytest.raises(DyngsError, match=r"it[: ]"):
            restore_model(
                checkpoint_of(scene, **{name: changed}), PredictedFieldModel(network=kind_of(scene))
            )
    del whole.tensors[f"field.{name}"]
    with pytest.raises((KeyError, DyngsError)):
        restore(PredictedFieldModel(network=kind_of(scene)), whole)
