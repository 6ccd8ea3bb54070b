"""Controls of a person: the motion that is played, and sliders for the main joints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyngs.view.network import MOST_IMAGES, PeopleNetwork
from dyngs.view.people import AS_CAPTURED, AT_REST, BY_SLIDERS, MAIN_JOINTS, in_motion

if TYPE_CHECKING:
    from dyngs.view.server import Browsing
    from dyngs.view.viewed import Viewed

_AXES = ("x", "y", "z")
_NONE = "-"


def add_person_controls(browsing: Browsing, motions: Mapping[str, Path]) -> None:
    """Add the motion picker and the sliders of the pose.

    Args:
        browsing: the browser, which has loaded a person.
        motions: motion files by name.
    """
    gui, session = browsing.client.gui, browsing.session
    angles: dict[str, tuple[float, float, float]] = {}
    motion = gui.add_dropdown("Motion", (AS_CAPTURED, AT_REST, BY_SLIDERS, *motions))
    joint = gui.add_dropdown("Joint", MAIN_JOINTS, initial_value="left_shoulder")
    sliders = [gui.add_slider(axis, -180.0, 180.0, 1.0, 0.0, hint=f"degrees about {axis}") for axis in _AXES]

    def play(_: Any = None) -> None:
        choice, chosen = str(motion.value), dict(angles)
        session.ask(lambda: session.show(in_motion(browsing.loaded, choice, motions, chosen)), "pose")

    def pick(_: Any) -> None:
        for slider, value in zip(sliders, angles.get(str(joint.value), (0.0, 0.0, 0.0)), strict=True):
            slider.value = value

    def turn(event: Any) -> None:
        if event.client_id is None:
            return
        x, y, z = (float(slider.value) for slider in sliders)
        angles[str(joint.value)] = (x, y, z)
        if motion.value == BY_SLIDERS:
            play()
        else:
            motion.value = BY_SLIDERS

    def reset(_: Any) -> None:
        angles.clear()
        pick(None)
        if motion.value == BY_SLIDERS:
            play()

    motion.on_update(play)
    joint.on_update(pick)
    for slider in sliders:
        slider.on_update(turn)
    gui.add_button("All joints at rest").on_click(reset)


def add_image_controls(browsing: Browsing, network: PeopleNetwork, show: Callable[[Viewed], None]) -> None:
    """Add the choice of the images that a network predicts the person from.

    Args:
        browsing: the browser, which has loaded a person of the network.
        network: the network.
        show: is given what was predicted.
    """
    gui, session, person = browsing.client.gui, browsing.session, browsing.loaded.name
    names = (_NONE, *network.images_of(person))
    hint = f"none: {network.num_images} that see much of the person"
    chosen = [gui.add_dropdown(f"Image {i + 1}", names, hint=hint) for i in range(MOST_IMAGES)]

    def predict(_: Any) -> None:
        images = tuple(dict.fromkeys(str(one.value) for one in chosen if one.value != _NONE))
        note = browsing.client.add_notification("Predicting", person, loading=True)

        def work() -> None:
            try:
                viewed = network.predict(person, images)
            finally:
                note.remove()
            browsing.loaded = viewed
            show(viewed)

        session.ask(work)

    gui.add_button("Predict").on_click(predict)
