"""Sessions of the viewer without a browser."""

from __future__ import annotations

import numpy as np
import torch
from moving_scene import Sliding, camera, moving_scene

from dyngs.view.cameras import pose_of
from dyngs.view.session import Eye, Sent, Session
from dyngs.view.viewed import Viewed


def balls() -> Viewed:
    """Five balls of which two move."""
    scene = moving_scene(Sliding())
    return Viewed("balls", scene, scene.options, torch.ones(3), camera(), np.zeros(3), 4.0, np.array([0.0, -1, 0]))


def looking_at_balls(size: tuple[int, int] = (200, 150)) -> tuple[Session, list[Sent]]:
    """A session with a camera, and the list of what it sends."""
    sent: list[Sent] = []
    session = Session(balls(), sent.append)
    wxyz, position = pose_of(camera())
    session.move(Eye(tuple(wxyz), tuple(position), 0.7, size))
    return session, sent
