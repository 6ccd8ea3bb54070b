"""The controls of the page: what is shown, the time, the truth, screenshots. Each browser has its
own."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyngs.core.errors import counted
from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import Opened
from dyngs.view.captured_views import has_timeline, views_of
from dyngs.view.edit_controls import EditControls, can_be_edited
from dyngs.view.frusta import Frusta
from dyngs.view.layers import LAYERS, PARTS, draw, shows_filled
from dyngs.view.markdown import as_text
from dyngs.view.people import AS_CAPTURED, AT_REST, BY_SLIDERS, MAIN_JOINTS, in_motion
from dyngs.view.recording import Keyframe, Recording
from dyngs.view.source import MOST_IMAGES, PeopleNetwork, Source

if TYPE_CHECKING:
    import viser

    from dyngs.view.server import Browsing, Serving

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
NEAREST = "nearest"
FPS = 30.0
FILE_NAME = "camera_path.json"
_AXES = ("x", "y", "z")
_NONE = "-"
HELP = """\
**Orbit**: drag; right button or two fingers: shift; wheel: nearer, farther.
**Fly**: W A S D, Q and E: down, up; arrow keys: turn.
**Cameras**: click one to go there.
"""


class Controls:
    """Controls of one browser; ``show`` makes them anew for another scene."""

    def __init__(self, browsing: Browsing, source: Source, serving: Serving) -> None:
        self._browsing, self._source, self._serving = browsing, source, serving
        self._frusta = Frusta(browsing)
        self._of_scene: list[Any] = []
        self.edits: EditControls | None = None
        gui = browsing.client.gui
        if len(source.names) > 1:
            chosen = next(
                (name for name in source.names if name == browsing.loaded.name), source.names[0]
            )
            runs = gui.add_dropdown(
                "Run" if source.network is None else "Person", source.names, initial_value=chosen
            )
            runs.on_update(lambda _: self._choose(str(runs.value)))
        browsing.status = gui.add_markdown("")
        self.show(browsing.loaded)

    def show(self, opened: Opened) -> None:
        """Make the controls that a scene needs."""
        for handle in self._of_scene:
            handle.remove()
        self._frusta.remove()
        if self.edits is not None:
            self.edits.remove()
            self.edits = None
        gui = self._browsing.client.gui
        browsing = self._browsing
        browsing.time_slider = None
        network = self._source.network
        parts = dict[str, Callable[[], None]]()
        parts["Show"] = lambda: self._add_display(gui, opened)
        if has_timeline(opened):
            parts["Time"] = lambda: self._add_time(gui)
        if len(views_of(opened)):
            parts["Capture"] = lambda: self._add_capture(gui, opened)
        if opened.person is not None and not opened.in_training:
            parts["Person"] = lambda: add_person_controls(browsing, self._serving.motions)
        if network is not None:
            parts["Predict from"] = lambda: add_image_controls(browsing, network)
        if can_be_edited(opened):
            parts["Edit"] = lambda: self._add_edits(opened)
        parts |= {
            "Camera path": lambda: add_path_controls(browsing),
            "Help": lambda: _add_help(gui, opened),
        }
        self._of_scene = []
        for name, add in parts.items():
            self._of_scene.append(
                gui.add_folder(name, expand_by_default=name not in ("Edit", "Camera path", "Help"))
            )
            with self._of_scene[-1]:
                add()

    def _add_edits(self, opened: Opened) -> None:
        self.edits = EditControls(self._browsing, opened)

    def _add_display(self, gui: viser.GuiApi, opened: Opened) -> None:
        session = self._browsing.session
        layers = [name for name in LAYERS if len(views_of(opened)) or name != "error"]
        layers = [
            name
            for name in layers
            if isinstance(opened.renderable, GaussianScene) or name != "motion"
        ]
        layers = [name for name in layers if shows_filled(opened) or name != "filled"]
        if session.look.layer not in layers:
            session.change(layer="colour")
        hint = "error: against the truth, at a camera of the capture"
        layer = gui.add_dropdown("What", layers, initial_value=session.look.layer, hint=hint)
        layer.on_update(lambda _: self._change(layer=layer.value))
        scene = opened.renderable if isinstance(opened.renderable, GaussianScene) else None
        has_parts = scene is not None and 0 < scene.num_moving < len(scene)
        if has_parts or (scene is not None and opened.in_training and has_timeline(opened)):
            part = gui.add_dropdown("Parts", PARTS, initial_value=session.look.part)
            part.on_update(lambda _: session.change(part=part.value))
        else:
            session.change(part="all")
        hint = "most pixels of the longer side, when all is still"
        longest = gui.add_slider("Sharpness", 200, 2400, 100, session.look.longest, hint=hint)
        longest.on_update(lambda _: session.change(longest=int(longest.value)))
        screenshot = gui.add_button("Screenshot", hint="as .png, of the size of the window")
        screenshot.on_click(lambda _: session.ask(self._screenshot))
        gui.add_button("Back to start").on_click(lambda _: self._browsing.go_to(None))

    def _add_time(self, gui: viser.GuiApi) -> None:
        session = self._browsing.session
        slider = gui.add_slider("Time", 0.0, 1.0, 0.001, round(session.time, 3))
        slider.on_update(
            lambda event: None if event.client_id is None else session.set_time(float(slider.value))
        )
        play = gui.add_button("Pause" if session.timeline.playing else "Play")
        play.on_click(lambda _: session.change_timeline(playing=not session.timeline.playing))
        session.on_play = lambda playing: setattr(play, "label", "Pause" if playing else "Play")
        loop = gui.add_checkbox("Loop", session.timeline.loops)
        loop.on_update(lambda _: session.change_timeline(loops=bool(loop.value)))
        shown = f"{session.timeline.speed:g}"
        speed = gui.add_dropdown("Speed", SPEEDS, initial_value=shown, hint="1: as it was filmed")
        speed.on_update(lambda _: session.change_timeline(speed=float(speed.value)))
        self._browsing.time_slider = slider

    def _add_capture(self, gui: viser.GuiApi, opened: Opened) -> None:
        session = self._browsing.session
        cameras = gui.add_checkbox(
            "Cameras", False, hint="frusta with their images; click one to go there"
        )
        cameras.on_update(
            lambda _: self._frusta.show(opened) if cameras.value else self._frusta.remove()
        )
        compare = gui.add_checkbox(
            "Compare", session.look.comparing, hint="with the truth, on the right of the line"
        )
        divide = gui.add_slider("Divide", 0.0, 1.0, 0.01, session.look.divide)
        view = gui.add_dropdown("Image", (NEAREST, *views_of(opened).names))
        session.change(view=None)
        compare.on_update(lambda _: self._change(comparing=bool(compare.value)))
        divide.on_update(lambda _: session.change(divide=float(divide.value)))

        def choose(_: Any) -> None:
            name = str(view.value)
            index = None if name == NEAREST else views_of(opened).names.index(name)
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
                opened = self._source.load(name)
            finally:
                note.remove()
            browsing.loaded = opened
            browsing.session.show(opened)
            self.show(opened)
            browsing.go_to(None)

        browsing.session.ask(load, "scene")

    def _screenshot(self) -> None:
        """Send what is shown as a .png, in the thread that draws."""
        from PIL import Image

        session = self._browsing.session
        stream = io.BytesIO()
        if session.eye is None:
            return
        Image.fromarray(draw(session.opened, session.shot())).save(stream, "png")
        name = f"{session.opened.name}_{session.time:.3f}.png"
        self._browsing.client.send_file_download(name, stream.getvalue(), save_immediately=True)


def _add_help(gui: viser.GuiApi, opened: Opened) -> None:
    gui.add_markdown(HELP)
    for note in opened.notes:
        gui.add_markdown(f"*{as_text(note)}*")


def add_person_controls(browsing: Browsing, motions: Mapping[str, Path]) -> None:
    """Add the motion picker, for files by name, and the sliders of the pose."""
    gui = browsing.client.gui
    session = browsing.session
    angles: dict[str, tuple[float, float, float]] = {}
    motion = gui.add_dropdown("Motion", (AS_CAPTURED, AT_REST, BY_SLIDERS, *motions))
    feet = gui.add_checkbox(
        "Keep feet", False, hint="in motions of files, feet on the floor do not slide"
    )
    joint = gui.add_dropdown("Joint", MAIN_JOINTS, initial_value="left_shoulder")
    sliders = [
        gui.add_slider(axis, -180.0, 180.0, 1.0, 0.0, hint=f"degrees about {axis}")
        for axis in _AXES
    ]

    def play(_: Any = None) -> None:
        choice = str(motion.value)
        chosen = dict(angles)
        keep = bool(feet.value)
        session.ask(
            lambda: session.show(
                in_motion(browsing.loaded, choice, motions, chosen, keep_feet=keep)
            ),
            "pose",
        )

    def pick(_: Any) -> None:
        for slider, value in zip(
            sliders, angles.get(str(joint.value), (0.0, 0.0, 0.0)), strict=True
        ):
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

    for handle in (motion, feet):
        handle.on_update(play)
    joint.on_update(pick)
    for slider in sliders:
        slider.on_update(turn)
    gui.add_button("All joints at rest").on_click(reset)


def add_image_controls(browsing: Browsing, network: PeopleNetwork) -> None:
    """Add the choice of the images that a network predicts the person from."""
    gui = browsing.client.gui
    session = browsing.session
    person = browsing.loaded.name
    names = (_NONE, *network.images_of(person))
    hint = f"none: {network.num_images} that see much of the person"
    chosen = [gui.add_dropdown(f"Image {i + 1}", names, hint=hint) for i in range(MOST_IMAGES)]

    def predict(_: Any) -> None:
        images = tuple(dict.fromkeys(str(one.value) for one in chosen if one.value != _NONE))
        note = browsing.client.add_notification("Predicting", person, loading=True)

        def work() -> None:
            try:
                opened = network.predict(person, images)
            finally:
                note.remove()
            browsing.loaded = opened
            session.show(opened)  # from the same camera
            browsing.client.add_notification("Predicted", opened.notes[-1], auto_close_seconds=8.0)

        session.ask(work)

    gui.add_button("Predict").on_click(predict)


def add_path_controls(browsing: Browsing) -> None:
    gui = browsing.client.gui
    session = browsing.session
    recorded = [Recording()]
    status = gui.add_markdown("no keyframes yet")
    seconds = gui.add_slider(
        "Seconds", 0.1, 20.0, 0.1, 2.0, hint="from the keyframe that is added to the next one"
    )

    def record(recording: Recording) -> None:
        recorded[0] = recording
        count = len(recording)
        duration = recording.duration if len(recording) else 0.0
        status.content = (
            f"{counted(count, 'keyframe')}, {duration:.1f} s" if count else "no keyframes yet"
        )

    def add(_: Any) -> None:
        if session.eye is not None:
            time = None if session.opened.renderable.is_static else session.time
            keyframe = Keyframe(session.eye.camera(), time, float(seconds.value))
            record(replace(recorded[0], keyframes=(*recorded[0].keyframes, keyframe)))

    def save(_: Any) -> None:
        if not len(recorded[0]):
            browsing.client.add_notification(
                "No path", "Add a keyframe first.", auto_close_seconds=5.0
            )
            return
        opened = session.opened
        first = recorded[0].keyframes[0].camera
        # as videos need it
        width, height = (2 * (side // 2) for side in (first.width, first.height))
        text = recorded[0].moved(opened.frame).document((width, height), FPS, opened.world_offset)
        browsing.client.send_file_download(FILE_NAME, text.encode(), save_immediately=True)

    gui.add_button("Add keyframe", hint="this camera, at this time").on_click(add)
    gui.add_button("Remove last").on_click(
        lambda _: record(replace(recorded[0], keyframes=recorded[0].keyframes[:-1]))
    )
    loop = gui.add_checkbox("Back to the first", False)
    loop.on_update(lambda _: record(replace(recorded[0], loops=bool(loop.value))))
    gui.add_button("Preview").on_click(lambda _: session.preview(recorded[0]))
    gui.add_button(
        "Save path", hint=f"{FILE_NAME}, for: dyngs render RUN --path {FILE_NAME}"
    ).on_click(save)
