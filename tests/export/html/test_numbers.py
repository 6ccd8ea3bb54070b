"""The numbers of scenes: how many, of what, and how large."""

from __future__ import annotations

import pytest
from scene_kinds import KINDS, scene_of_kind

from dyngs.export.html.lists import Lists
from dyngs.export.html.numbers import add_scene


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_the_lists_that_it_needs(kind: str) -> None:
    scene, lists = scene_of_kind(kind), Lists()
    told = add_scene(scene, lists, 0.01)
    layout = lists.layout
    assert (told["count"], told["moves"]) == (len(scene), not scene.is_static)
    for name, columns in {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1, "base": 3}.items():
        assert (layout[name]["rows"], layout[name]["columns"]) == (len(scene), columns)
    assert ("boned" in layout, "bones" in told) == (kind == "human",) * 2
    assert ("masks" in layout) == (kind == "masked")
    assert ("pivots" in layout) == (kind == "control_nodes")
    assert ("network" in told) == (scene.colour is not None)
    assert ("rest" in layout) == (scene.colour is None and scene.gaussians.sh_degree > 0)
    assert ("curve_means" in layout) == (kind != "static")


def test_lists_lie_one_after_the_other() -> None:
    lists = Lists()
    add_scene(scene_of_kind("control_nodes"), lists, 0.01)
    places = sorted(told["at"] for told in lists.layout.values())
    assert places[0] == 0
    assert len(set(places)) == len(places)
    assert places[-1] < lists.size
