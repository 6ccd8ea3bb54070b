"""The controls of the page: what is shown, the time, the truth, screenshots. Each browser has its own."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from dyngs.gaussians.scene import Scene
from dyngs.view.frusta import Frusta
from dyngs.view.layers import LAYERS, PARTS, draw
from dyngs.view.path_controls import add_path_controls
from dyngs.view.people import person_in
from dyngs.view.people_controls import add_image_controls, add_person_controls
from dyngs.view.source import Source
from dyngs.view.viewed import Viewed

if TYPE_CHECKING:
    import viser

    from dyngs.view.server import Browsing, Serving

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
NEAREST = "nearest"
HELP = """\
**Orbit**: drag; right button or two fingers: shift; wheel: nearer, farther.
**Fly**: W A S D, Q and E: down, up; arrow keys: turn.
**Cameras**: click one to go there.
"""


class Controls:
    """Controls of one browser; ``show`` makes them anew for another scene.

    Args:
        browsing: the browser.
        source: scenes to choose from.
        serving: how the page is served.
    """

    def __init__(self, browsing: Browsing, source: Source, serving: Serving) -> None:
        self._browsing, self._source, self._serving = browsing, source, serving
        self._frusta = Frusta(browsing)
        self._of_scene: list[Any] = []
        gui = browsing.client.gui
        if len(source.names) > 1:
            chosen = next((name for name in source.names if name == browsing.loaded.name), source.names[0])
            runs = gui.add_dropdown("Run" if source.network is None else "Person", source.names, initial_value=chosen)
            runs.on_update(lambda _: self._choose(str(runs.value)))
        browsing.status = gui.add_markdown("")
        self.show(browsing.loaded)

    def show(self, viewed: Viewed) -> None:
        """Make the controls that a scene needs."""
        for handle in self._of_scene:
            handle.remove()
        self._frusta.remove()
        gui, browsing = self._browsing.client.gui, self._browsing
        look = gui.add_folder("Show")
        with look:
            self._add_look(gui, viewed)
        folders = [look]
        browsing.time_slider = None
        if viewed.has_timeline:
            folders.append(gui.add_folder("Time"))
            with folders[-1]:
                self._add_time(gui)
        if len(viewed.footage):
            folders.append(gui.add_folder("Capture"))
            with folders[-1]:
                self._add_capture(gui, viewed)
        if person_in(viewed) is not None and not viewed.in_training:
            folders.append(gui.add_folder("Person"))
            with folders[-1]:
                add_person_controls(browsing, self._serving.motions)
        if self._source.network is not None:
            folders.append(gui.add_folder("Predict from"))
            with folders[-1]:
                add_image_controls(browsing, self._source.network, self._predicted)
        folders.append(gui.add_folder("Camera path", expand_by_default=False))
        with folders[-1]:
            add_path_controls(browsing)
        folders.append(gui.add_folder("Help", expand_by_default=False))
        with folders[-1]:
            gui.add_markdown(HELP)
            for note in viewed.notes:
                gui.add_markdown(f"*{note}*")
        self._of_scene = folders

    def _add_look(self, gui: viser.GuiApi, viewed: Viewed) -> None:
        session = self._browsing.session
        layers = [name for name in LAYERS if len(viewed.footage) or name != "error"]
        layers = [name for name in layers if isinstance(viewed.scene, Scene) or name != "motion"]
        if session.look.layer not in layers:
            session.change(layer="colour")
        layer = gui.add_dropdown(
            "What",
            layers,
            initial_value=session.look.layer,
            hint="error: against the truth, at a camera of the capture",
        )
        layer.on_update(lambda _: self._change(layer=layer.value))
        scene = viewed.scene if isinstance(viewed.scene, Scene) else None
        has_parts = scene is not None and 0 < scene.num_moving < len(scene)
        if has_parts or (scene is not None and viewed.in_training and viewed.has_timeline):
            part = gui.add_dropdown("Parts", PARTS, initial_value=session.look.part)
            part.on_update(lambda _: session.change(part=part.value))
        else:
            session.change(part="all")
        longest = gui.add_slider(
            "Sharpness", 200, 2400, 100, session.look.longest, hint="most pixels of the longer side, when all is still"
        )
        longest.on_update(lambda _: session.change(longest=int(longest.value)))
        gui.add_button("Screenshot", hint="as .png, of the size of the window").on_click(
            lambda _: session.ask(self._screenshot)
        )
        gui.add_button("Back to start").on_click(lambda _: self._browsing.go_to(None))

    def _add_time(self, gui: viser.GuiApi) -> None:
        session = self._browsing.session
        slider = gui.add_slider("Time", 0.0, 1.0, 0.001, round(session.time, 3))
        slider.on_update(lambda event: None if event.client_id is None else session.set_time(float(slider.value)))
        play = gui.add_button("Pause" if session.timeline.playing else "Play")

        def toggle(_: Any) -> None:
            session.change_timeline(playing=not session.timeline.playing)

        play.on_click(toggle)
        session.on_play = lambda playing: setattr(play, "label", "Pause" if playing else "Play")
        loop = gui.add_checkbox("Loop", session.timeline.loops)
        loop.on_update(lambda _: session.change_timeline(loops=bool(loop.value)))
        speed = gui.add_dropdown(
            "Speed", SPEEDS, initial_value=f"{session.timeline.speed:g}", hint="1: as it was filmed"
        )
        speed.on_update(lambda _: session.change_timeline(speed=float(speed.value)))
        self._browsing.time_slider = slider

    def _add_capture(self, gui: viser.GuiApi, viewed: Viewed) -> None:
        session = self._browsing.session
        cameras = gui.add_checkbox("Cameras", False, hint="frusta with their images; click one to go there")
        cameras.on_update(lambda _: self._frusta.show(viewed) if cameras.value else self._frusta.remove())
        compare = gui.add_checkbox("Compare", session.look.comparing, hint="with the truth, on the right of the line")
        divide = gui.add_slider("Divide", 0.0, 1.0, 0.01, session.look.divide)
        view = gui.add_dropdown("Image", (NEAREST, *viewed.footage.names))
        session.change(view=None)
        compare.on_update(lambda _: self._change(comparing=bool(compare.value)))
        divide.on_update(lambda _: session.change(divide=float(divide.value)))

        def choose(_: Any) -> None:
            name = str(view.value)
            index = None if name == NEAREST else viewed.footage.names.index(name)
            session.change(view=index)
            if index is not None:
                self._browsing.go_to(index)

        view.on_update(choose)

    def _change(self, **changes: Any) -> None:
        """Show something else, which frusta may cover."""
        self._browsing.session.change(**changes)
        self._frusta.hide_what_covers()

    def _choose(self, name: str) -> None:
        """Load another scene, in the thread that draws."""
        browsing = self._browsing
        note = browsing.client.add_notification("Loading", name, loading=True)

        def load() -> None:
            try:
                viewed = self._source.load(name)
            finally:
                note.remove()
            browsing.loaded = viewed
            browsing.session.show(viewed)
            self.show(viewed)
            browsing.go_to(None)

        browsing.session.ask(load, "scene")

    def _predicted(self, viewed: Viewed) -> None:
        """Show the person as predicted from other images, from the same camera."""
        browsing = self._browsing
        browsing.session.show(viewed)
        browsing.client.add_notification("Predicted", viewed.notes[-1], auto_close_seconds=8.0)

    def _screenshot(self) -> None:
        """Send what is shown as a .png, in the thread that draws."""
        browsing = self._browsing
        if browsing.session.eye is None:
            return
        image = draw(browsing.session.viewed, browsing.session.shot())
        name = f"{browsing.session.viewed.name}_{browsing.session.time:.3f}.png"
        browsing.client.send_file_download(name, png_of(image), save_immediately=True)


def add_controls(browsing: Browsing, source: Source, serving: Serving) -> Controls:
    """Add all controls to the page of one browser."""
    return Controls(browsing, source, serving)


def png_of(image: np.ndarray) -> bytes:
    """Return an image (H, W, 3) uint8 as the bytes of a .png file."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "png")
    return stream.getvalue()
