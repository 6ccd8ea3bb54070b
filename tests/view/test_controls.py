"""Controls of the page, tested without a browser."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from moving_scene import write_moving_run
from PIL import Image
from scene_kinds import scene_of_kind
from view_sessions import Page, looking_at_balls, opened_at

from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.runs.opened import OpenedScene, open_run
from dyngs.view.controls import BODY_JOINTS, BY_SLIDERS, Controls, pose_person
from dyngs.view.layers import draw
from dyngs.view.source import SceneSource
from dyngs.view.views import views_of


def page_of(opened: OpenedScene | None = None, motions: dict[str, Path] | None = None) -> Page:
    session, _ = looking_at_balls()
    session.opened = opened or session.opened
    page: Any = Page(session)
    Controls(page, SceneSource(("it",), lambda _: session.opened), motions or {})
    return page


def person() -> OpenedScene:
    return opened_at(scene_of_kind("human"), "person")


def test_sliders_pose_a_person_from_the_rest_pose() -> None:
    page = page_of(person())
    page.set("Joint", "left_elbow")
    page.set("y", 90.0)
    shown = page.session.opened
    assert page.controls["Motion"].value == BY_SLIDERS
    moved = shown.scene.at(None).means - page.loaded.at_rest().scene.at(None).means
    assert shown.scene.is_static
    far = moved.norm(dim=1)
    assert far.max() > 5 * far.median() > 0, "the arm, and a little what its pose blends"
    page.set("Joint", "neck")
    assert page.controls["y"].value == 0.0
    page.set("Joint", "left_elbow")
    assert page.controls["y"].value == 90.0
    zero = pose_person(page.loaded, {"pelvis": (0.0, 0.0, 0.0)})
    rest = page.loaded.at_rest().scene.at(None).means
    assert torch.allclose(zero.scene.at(None).means, rest, atol=1e-6)


def test_every_body_has_the_joints_with_sliders() -> None:
    for rows in SMPLX_ROWS.values():
        assert rows[: len(BODY_JOINTS)] == tuple(range(len(BODY_JOINTS)))


def test_motions_of_files_are_played(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path] = []

    def play_motion(opened: OpenedScene, path: Path) -> OpenedScene:
        asked.append(path)
        return opened

    monkeypatch.setattr(OpenedScene, "play_motion", play_motion)
    page = page_of(person(), {"walk.npz": Path("walk.npz")})
    page.set("Motion", "walk.npz")
    assert asked == [Path("walk.npz")]


def test_a_screenshot_is_what_is_shown() -> None:
    page = page_of()
    page.set("Layer", "alpha")
    page.set("Screenshot")
    ((name, data),) = page.files.items()
    assert name == "balls_0.000.png"
    shown = draw(page.session.opened, page.session.view_request())
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), shown)


def test_the_background_is_chosen() -> None:
    page = page_of()
    session = page.session
    for choice, corner in (
        ("black", 0),
        ("white", 255),
        ("of the scene", 255),
        ("custom", (9, 8, 7)),
    ):
        page.set("Custom", (9, 8, 7))
        page.set("Background", choice)
        assert (draw(session.opened, session.view_request())[0, 0] == corner).all(), choice
    page.set("Custom", (1, 2, 3))
    assert (draw(session.opened, session.view_request())[0, 0] == (1, 2, 3)).all()


def test_an_image_is_chosen_by_name(tmp_path: Path) -> None:
    page = page_of(open_run(write_moving_run(tmp_path)))
    assert page.session.view_request().view is None
    page.set("Compare", True)
    nearest = page.session.view_request().view
    assert nearest is not None
    names = views_of(page.session.opened).names
    other = (nearest + 1) % len(names)
    page.set("Image", names[other])
    assert page.session.view_request().view == other
    assert page.went_to == [other]
    page.set("Image", "nearest")
    assert page.session.view_request().view == nearest
    page.set("Loop", False)
    assert not page.session.timeline.loops
