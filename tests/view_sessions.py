"""Sessions of the viewer without a browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from moving_scene import Sliding, camera, moving_scene

from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import Opened, opened_scene
from dyngs.view.session import Eye, Sent, Session
from dyngs.view.views import Viewpoint, pose_of


def opened_at(scene: GaussianScene, name: str = "balls") -> Opened:
    """A scene on white, looked at from 4 away."""
    opened = replace(
        opened_scene(replace(scene, background=torch.ones(3)), Path(name)), stated_up="-y"
    )
    opened.once("viewpoint", lambda: Viewpoint(camera(), np.zeros(3), 4.0, np.array([0.0, -1, 0])))
    return opened


def balls() -> Opened:
    """Five balls of which two move."""
    return opened_at(moving_scene(Sliding()))


def looking_at_balls(size: tuple[int, int] = (200, 150)) -> tuple[Session, list[Sent]]:
    """A session with a camera, and the list of what it sends."""
    sent: list[Sent] = []
    session = Session(balls(), sent.append)
    wxyz, position = pose_of(camera())
    session.move(Eye(tuple(wxyz), tuple(position), 0.7, size))
    return session, sent
