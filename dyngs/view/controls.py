"""Controls of the viewer page: display, time, capture cameras, motions, camera paths, screenshots.

Each browser has its own controls.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dyngs.core.errors import DyngsError, format_count
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.scene import as_human_scene
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import compose_rotations
from dyngs.io.write import to_uint8
from dyngs.runs.opened import OpenedScene
from dyngs.view.edit import EditControls, can_be_edited
from dyngs.view.layers import LAYERS, PARTS, draw
from dyngs.view.session import Keyframe, Recording
from dyngs.view.source import SceneSource
from dyngs.view.views import centers_of, has_timeline, initial_viewpoint, pose_of, views_of

if TYPE_CHECKING:
    import viser

    from dyngs.view.server import BrowserConnection

NEAREST = "nearest"
BACKGROUNDS = "of the scene", "black", "white", "custom"
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
AS_CAPTURED, AT_REST, BY_SLIDERS = "as captured", "rest pose", "pose sliders"
BODY_JOINTS = JOINT_NAMES[:22]  # Joints with sliders, common to all bodies
FILE_NAME = "camera_path.json"
MOTION_SUFFIXES = (".npz", ".bvh", ".glb", ".gltf", ".vrma")
HELP = """\
**Orbit**: drag to rotate, right button or two fingers to pan, wheel to zoom.
**Fly**: W A S D to move, Q and E for down and up, arrow keys to rotate.
**Cameras**: click a camera to go there.
"""


class Controls:
    """Controls of one browser. ``show`` rebuilds them for another scene."""

    def __init__(
        self, connection: BrowserConnection, source: SceneSource, motions: Mapping[str, Path]
    ) -> None:
        self._connection, self._source, self._motions = connection, source, motions
        self._frusta = CameraFrusta(connection)
        self._folders: list[Any] = []
        self._edits: EditControls | None = None
        gui = connection.client.gui
        names = source.names
        if len(names) > 1:
            first = connection.loaded.name
            chosen = first if first in names else names[0]
            runs = gui.add_dropdown("Run", names, initial_value=chosen)
            runs.on_update(lambda _: self._choose(str(runs.value)))
        connection.status = gui.add_markdown("")
        self.show(connection.loaded)

    def show(self, opened: OpenedScene) -> None:
        """Create the controls for a scene."""
        for handle in self._folders:
            handle.remove()
        self._frusta.remove()
        if self._edits is not None:
            self._edits.remove()
            self._edits = None
        connection = self._connection
        gui = connection.client.gui
        connection.time_slider = None
        parts = dict[str, Callable[[], None]]()
        parts["Show"] = lambda: self._add_display(gui, opened)
        if has_timeline(opened):
            parts["Time"] = lambda: self._add_time(gui)
        if len(views_of(opened)):
            parts["Capture"] = lambda: self._add_capture(gui, opened)
        if opened.person is not None and not opened.in_training:
            parts["Person"] = lambda: self._add_motions(gui)
        if can_be_edited(opened):
            parts["Edit"] = lambda: self._add_edits(opened)
        parts["Camera path"] = lambda: self._add_path(gui)
        parts["Help"] = lambda: _add_help(gui, opened)
        self._folders = []
        for name, add in parts.items():
            is_open = name not in ("Edit", "Camera path", "Help")
            self._folders.append(gui.add_folder(name, expand_by_default=is_open))
            with self._folders[-1]:
                add()

    def _choose(self, name: str) -> None:
        """Load another scene, in the render thread."""
        connection = self._connection
        note = connection.client.add_notification("Loading", name, loading=True)

        def load() -> None:
            try:
                connection.loaded = self._source.load(name)
            finally:
                note.remove()
            connection.session.show(connection.loaded)
            self.show(connection.loaded)
            connection.go_to(None)

        connection.session.submit_job(load)

    def _change(self, **changes: Any) -> None:
        """Change the display, and hide frusta that cover it."""
        self._connection.session.change(**changes)
        self._frusta.hide_covering_frusta()

    def _add_edits(self, opened: OpenedScene) -> None:
        self._edits = EditControls(self._connection, opened)

    def _add_display(self, gui: viser.GuiApi, opened: OpenedScene) -> None:
        session = self._connection.session
        scene = opened.renderable if isinstance(opened.renderable, GaussianScene) else None
        layers = [name for name in LAYERS if name != "error" or len(views_of(opened))]
        if session.display.layer not in layers:
            session.change(layer="colour")
        hint = "error: difference to the true image, at a camera of the capture"
        layer = gui.add_dropdown("Layer", layers, initial_value=session.display.layer, hint=hint)
        layer.on_update(lambda _: self._change(layer=layer.value))
        has_parts = scene is not None and 0 < scene.num_moving < len(scene)
        if has_parts or (scene is not None and opened.in_training and has_timeline(opened)):
            part = gui.add_dropdown("Parts", PARTS, initial_value=session.display.part)
            part.on_update(lambda _: session.change(part=part.value))
        else:
            session.change(part="all")
        background = gui.add_dropdown("Background", BACKGROUNDS)
        custom = gui.add_rgb("Custom", (128, 128, 128), visible=False)

        def choose(_: Any) -> None:
            custom.visible = background.value == "custom"
            colours = {"black": (0, 0, 0), "white": (255, 255, 255), "custom": custom.value}
            session.change(background=colours.get(background.value))

        background.on_update(choose)
        custom.on_update(choose)
        session.change(background=None)
        screenshot = gui.add_button("Screenshot", hint="save as .png in window size")
        screenshot.on_click(lambda _: session.submit_job(self._screenshot))
        gui.add_button("Reset view").on_click(lambda _: self._connection.go_to(None))

    def _screenshot(self) -> None:
        """Send the current view as .png, in the render thread."""
        from PIL import Image

        session = self._connection.session
        stream = io.BytesIO()
        Image.fromarray(draw(session.opened, session.view_request())).save(stream, "png")
        name = f"{session.opened.name}_{session.time:.3f}.png"
        self._connection.client.send_file_download(name, stream.getvalue(), save_immediately=True)

    def _add_time(self, gui: viser.GuiApi) -> None:
        session = self._connection.session
        timeline = session.timeline
        slider = gui.add_slider("Time", 0.0, 1.0, 0.001, round(session.time, 3))
        slider.on_update(
            lambda event: None if event.client_id is None else session.set_time(float(slider.value))
        )
        play = gui.add_button("Pause" if timeline.playing else "Play")
        play.on_click(lambda _: session.change_timeline(playing=not session.timeline.playing))
        session.on_play = lambda playing: setattr(play, "label", "Pause" if playing else "Play")
        loop = gui.add_checkbox("Loop", timeline.loops)
        loop.on_update(lambda _: session.change_timeline(loops=bool(loop.value)))
        hint = "1: real time"
        speed = gui.add_dropdown("Speed", SPEEDS, initial_value=f"{timeline.speed:g}", hint=hint)
        speed.on_update(lambda _: session.change_timeline(speed=float(speed.value)))
        self._connection.time_slider = slider

    def _add_capture(self, gui: viser.GuiApi, opened: OpenedScene) -> None:
        session = self._connection.session
        hint = "camera frusta with images; click one to go there"
        cameras = gui.add_checkbox("Cameras", False, hint=hint)
        cameras.on_update(
            lambda _: self._frusta.show(opened) if cameras.value else self._frusta.remove()
        )
        hint = "show the true image on the right of the line"
        compare = gui.add_checkbox("Compare", session.display.comparing, hint=hint)
        compare.on_update(lambda _: self._change(comparing=bool(compare.value)))
        divide = gui.add_slider("Divide", 0.0, 1.0, 0.01, session.display.divide)
        divide.on_update(lambda _: session.change(divide=float(divide.value)))
        names = (NEAREST, *views_of(opened).names)
        image = gui.add_dropdown("Image", names)
        session.change(view=None)

        def choose(_: Any) -> None:
            index = names.index(image.value) - 1
            session.change(view=None if index < 0 else index)
            if index >= 0:
                self._connection.go_to(index)

        image.on_update(choose)

    def _add_motions(self, gui: viser.GuiApi) -> None:
        """Add the motion list and the pose sliders."""
        connection = self._connection
        motion = gui.add_dropdown("Motion", (AS_CAPTURED, AT_REST, BY_SLIDERS, *self._motions))
        joint = gui.add_dropdown("Joint", BODY_JOINTS)
        sliders = [gui.add_slider(axis, -180.0, 180.0, 1.0, 0.0) for axis in "xyz"]
        angles: dict[str, list[float]] = {}

        def work() -> None:
            choice = str(motion.value)
            opened = connection.loaded
            if choice == AT_REST:
                opened = opened.at_rest()
            elif choice == BY_SLIDERS:
                opened = pose_person(opened, angles)
            elif choice != AS_CAPTURED:
                opened = opened.play_motion(self._motions[choice])
            connection.session.show(opened)

        def play(_: Any) -> None:
            connection.session.submit_job(work)

        def pick(_: Any) -> None:
            shown = angles.get(joint.value, [0.0] * 3)
            for slider, value in zip(sliders, shown, strict=True):
                slider.value = value

        def turn(event: Any) -> None:
            if event.client_id is not None:  # None: set by ``pick``
                angles[joint.value] = [float(slider.value) for slider in sliders]
                motion.value = BY_SLIDERS
                play(event)

        motion.on_update(play)
        joint.on_update(pick)
        for slider in sliders:
            slider.on_update(turn)

    def _add_path(self, gui: viser.GuiApi) -> None:
        connection = self._connection
        session = connection.session
        recording = Recording()
        status = gui.add_markdown("no keyframes")
        hint = "duration from the added keyframe to the next one"
        seconds = gui.add_slider("Seconds", 0.1, 20.0, 0.1, 2.0, hint=hint)

        def record(**changes: Any) -> None:
            nonlocal recording
            recording = replace(recording, **changes)
            count = format_count(len(recording), "keyframe")
            status.content = f"{count}, {recording.duration:.1f} s"

        def add(_: Any) -> None:
            if session.browser_camera is not None:
                time = None if session.opened.renderable.is_static else session.time
                keyframe = Keyframe(session.browser_camera.camera(), time, float(seconds.value))
                record(keyframes=(*recording.keyframes, keyframe))

        def save(_: Any) -> None:
            if len(recording):
                first = recording.keyframes[0].camera
                size = first.width // 2 * 2, first.height // 2 * 2  # even size for videos
                text = recording.document(size, 30.0, session.opened)
                client = connection.client
                client.send_file_download(FILE_NAME, text.encode(), save_immediately=True)

        gui.add_button("Add keyframe", hint="add current camera and time").on_click(add)
        remove = gui.add_button("Remove last")
        remove.on_click(lambda _: record(keyframes=recording.keyframes[:-1]))
        loop = gui.add_checkbox("Close loop", False)
        loop.on_update(lambda _: record(loops=bool(loop.value)))
        preview = gui.add_button("Preview")
        preview.on_click(lambda _: session.preview(recording) if len(recording) else None)
        hint = f"save {FILE_NAME} for dyngs render RUN --path {FILE_NAME}"
        gui.add_button("Save path", hint=hint).on_click(save)


def _add_help(gui: viser.GuiApi, opened: OpenedScene) -> None:
    from dyngs.view.server import escape_markdown

    gui.add_markdown(HELP)
    for note in opened.notes:
        gui.add_markdown(f"*{escape_markdown(note)}*")


def pose_person(opened: OpenedScene, angles: Mapping[str, Sequence[float]]) -> OpenedScene:
    """Return a person in rest pose with joints rotated by ``angles``: degrees about x, y, z, by
    joint."""
    from scipy.spatial.transform import Rotation

    rest = opened.at_rest()
    person = as_human_scene(rest.renderable)
    clip = None if person is None else person.replacement_clip
    if person is None or clip is None:
        return rest
    turns = torch.zeros_like(clip.poses)
    for name, degrees in angles.items():
        turned = Rotation.from_euler("xyz", degrees, degrees=True)
        turns[0, JOINT_NAMES.index(name)] = turns.new_tensor(turned.as_rotvec())
    poses = compose_rotations(clip.poses, turns)
    return rest.with_scene(person.with_motion(replace(clip, poses=poses)))


def motion_files(path: Path | None) -> dict[str, Path]:
    """Return at most 500 motion files in a folder, or a single file, by name. Empty for None.

    Raises:
        DyngsError: the folder contains no motion files.
    """
    if path is None:
        return {}
    if path.is_file():
        return {path.name: path}
    found = sorted(file for file in path.rglob("*") if file.suffix.lower() in MOTION_SUFFIXES)
    if not found:
        raise DyngsError(f"--motion {path}: no motion files found ({', '.join(MOTION_SUFFIXES)})")
    return {file.relative_to(path).as_posix(): file for file in found[:500]}


# Camera frusta

MOST_FRUSTA = 120  # Most frusta shown, evenly chosen


class CameraFrusta:
    """Frusta of the capture's cameras in one browser."""

    def __init__(self, connection: BrowserConnection) -> None:
        self._connection = connection
        self._handles: list[tuple[Any, np.ndarray, float]] = []
        connection.on_move = self.hide_covering_frusta

    def show(self, opened: OpenedScene) -> None:
        """Add the frusta one by one in the render thread, one per static camera."""
        self.remove()
        handles = self._handles
        views = views_of(opened).views
        poses = np.stack([view.cam_from_world for view in views])
        centers = centers_of(poses)
        size = 0.05 * initial_viewpoint(opened).extent
        # Cameras of a video are close together.
        spread = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
        size = min(size, 0.15 * spread) if spread > 1e-3 * size else size
        indices = list({pose.tobytes(): i for i, pose in enumerate(poses)}.values())
        for index in (indices[i] for i in evenly_spaced(len(indices), MOST_FRUSTA)):
            self._connection.session.submit_job(
                lambda index=index: self._add(opened, index, size, handles)
            )

    def remove(self) -> None:
        handles = self._handles
        self._handles = []
        for handle, _, _ in handles:
            handle.remove()

    def hide_covering_frusta(self) -> None:
        """Hide frusta close to the browser camera, and all frusta while another view is shown."""
        session = self._connection.session
        browser_camera = session.browser_camera
        if browser_camera is None:
            return
        is_elsewhere = session.shown_view is not None
        for handle, position, size in list(self._handles):
            # The image of a frustum covers the scene up to 1.5 times its depth.
            is_near = float(np.linalg.norm(position - browser_camera.position)) < 1.5 * size
            handle.visible = not (is_elsewhere or is_near)

    def _add(self, opened: OpenedScene, index: int, size: float, handles: list[Any]) -> None:
        if handles is not self._handles:
            return  # removed meanwhile
        shown = views_of(opened)
        camera = shown.cameras[index]
        wxyz, position = pose_of(camera)
        image = None
        if shown.thumbnails is not None:
            image = to_uint8(shown.thumbnails[index].composite(opened.background).numpy())
        handle = self._connection.client.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=2 * float(np.arctan(0.5 * camera.height / camera.intrinsics[0, 1, 1])),
            aspect=camera.width / camera.height,
            scale=size,
            thickness=0.03 * size,
            color=(230, 160, 30),
            image=image,
            format="jpeg",
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(lambda _: self._go(index))
        handles.append((handle, position, size))
        self.hide_covering_frusta()

    def _go(self, index: int) -> None:
        connection = self._connection
        opened = connection.session.opened
        time = views_of(opened).views[index].time
        connection.go_to(index)
        if time is not None and not opened.renderable.is_static:
            connection.session.set_time(time)
            if connection.time_slider is not None:
                connection.time_slider.value = round(time, 3)
