"""Neighbours on a ring of cameras, and views that are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.human.predict.gps.rectification import (
    best_pair,
    neighbour_pairs,
    order_around_person,
    order_as_pair,
    spread_around_person,
    training_pairs,
)


def view_at(
    degrees: float, height: float = 1.0, frame: int = 0, toward: tuple[float, ...] = (0, 1.0, 0)
) -> View:
    """3 m from the vertical through ``toward``, in the azimuth of ``degrees`` from +z to +x, OpenCV
    axes."""
    turn = np.radians(degrees)
    center = np.array([3 * np.sin(turn), height, 3 * np.cos(turn)])
    forward = np.array(toward) - center
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    name = f"f{frame}_{degrees:g}"
    return View(name, Path(f"{name}.png"), pose, np.eye(3), 8, 8, frame=frame)


RING = [view_at(x) for x in (90, 0, 45, 315, 135, 180, 225, 270)]


def test_order_around_the_vertical_starts_anywhere() -> None:
    degrees = [float(RING[i].name[3:]) for i in order_around_person(RING, range(8))]
    steps = np.diff([*degrees, degrees[0]]) % 360
    assert len(set(steps.tolist())) == 1
    assert steps[0] in (45, 315)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (view_at(0), view_at(180)),
        (view_at(0), view_at(60)),
        (view_at(0), view_at(0)),
        (view_at(0), view_at(2)),
        (view_at(0), view_at(30, frame=1)),
        (view_at(0, 0.5), view_at(1, 2.5)),
    ],
)
def test_unsuitable_pairs_are_refused(one: View, other: View) -> None:
    assert order_as_pair([one, other], 0, 1) is None
    for chosen in ([0, 1], [0]):
        with pytest.raises(DyngsError, match=rf"^ann: {one.name} has no neighbouring view"):
            neighbour_pairs("ann", [one, other], chosen)


def test_views_are_chosen_around_the_ring() -> None:
    assert len(neighbour_pairs("ann", RING, spread_around_person(RING, 8))) == 8
    two = best_pair(RING)
    assert len(neighbour_pairs("ann", RING, two)) == 1
    dense = [view_at(10 * i) for i in range(36)]
    left, right = neighbour_pairs("ann", dense, best_pair(dense))[0]
    turned = (float(dense[right].name[3:]) - float(dense[left].name[3:])) % 360
    assert turned == 30
    assert len(neighbour_pairs("ann", dense, spread_around_person(dense, 12))) == 12
    later = [replace(view, frame=1, name=f"later_{view.name}") for view in dense]
    assert {dense[i % 36].frame for i in spread_around_person([*dense[:5], *later], 9)} == {0}
    assert all(i >= 5 for i in spread_around_person([*dense[:5], *later], 9)), (
        "of the moment that most views show"
    )


def test_lessons_have_views_in_between() -> None:
    dense = [view_at(15 * i) for i in range(24)]
    found = training_pairs(dense)
    assert len(found) == 48, "two and three steps of 15 degrees"
    for pair, between in found:
        left, right = (float(dense[i].name[3:]) for i in pair)
        assert (right - left) % 360 == 15 * (len(between) + 1)
        assert {(float(dense[i].name[3:]) - left) % 360 for i in between} == {
            15 * (k + 1.0) for k in range(len(between))
        }
    assert training_pairs(RING) == [], (
        "45 degrees apart, so that nothing is between neighbours that suit"
    )
