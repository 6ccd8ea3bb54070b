"""The controls of the page: what is shown, the time, the truth, the cameras of the capture, poses of
a person, camera paths, screenshots. Each browser has its own."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dyngs.core.errors import DyngsError, counted
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.motion.placement import rest_clip
from dyngs.io.write import to_uint8
from dyngs.runs.opened import Opened
from dyngs.view.edit import EditControls, can_be_edited
from dyngs.view.layers import LAYERS, PARTS, draw, shows_filled
from dyngs.view.session import Keyframe, Recording
from dyngs.view.source import MOST_IMAGES, PeopleNetwork, Source
from dyngs.view.views import centers_of, has_timeline, pose_of, viewpoint_of, views_of

if TYPE_CHECKING:
    import viser

    from dyngs.view.server import Browsing

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
NEAREST = "nearest"
FPS = 30.0
FILE_NAME = "camera_path.json"
_NONE = "-"
HELP = """\
**Orbit**: drag; right button or two fingers: shift; wheel: nearer, farther.
**Fly**: W A S D, Q and E: down, up; arrow keys: turn.
**Cameras**: click one to go there.
"""


class Controls:
    """Controls of one browser; ``show`` makes them anew for another scene."""

    def __init__(self, browsing: Browsing, source: Source, motions: Mapping[str, Path]) -> None:
        self._browsing, self._source, self._motions = browsing, source, motions
        self._frusta = Frusta(browsing)
        self._folders: list[Any] = []
        self._edits: EditControls | None = None
        gui = browsing.client.gui
        names = source.names
        if len(names) > 1:
            label = "Run" if source.network is None else "Person"
            first = browsing.loaded.name
            chosen = first if first in names else names[0]
            runs = gui.add_dropdown(label, names, initial_value=chosen)
            runs.on_update(lambda _: self._choose(str(runs.value)))
        browsing.status = gui.add_markdown("")
        self.show(browsing.loaded)

    def show(self, opened: Opened) -> None:
        """Make the controls that a scene needs."""
        for handle in self._folders:
            handle.remove()
        self._frusta.remove()
        if self._edits is not None:
            self._edits.remove()
            self._edits = None
        browsing = self._browsing
        gui = browsing.client.gui
        browsing.time_slider = None
        network = self._source.network
        parts = dict[str, Callable[[], None]]()
        parts["Show"] = lambda: self._add_display(gui, opened)
        if has_timeline(opened):
            parts["Time"] = lambda: _add_time(gui, browsing)
        if len(views_of(opened)):
            parts["Capture"] = lambda: self._add_capture(gui, opened)
        if opened.person is not None and not opened.in_training:
            parts["Person"] = lambda: add_person_controls(browsing, self._motions)
        if network is not None:
            parts["Predict from"] = lambda: add_image_controls(browsing, network)
        if can_be_edited(opened):
            parts["Edit"] = lambda: self._add_edits(opened)
        parts["Camera path"] = lambda: add_path_controls(browsing)
        parts["Help"] = lambda: _add_help(gui, opened)
        self._folders = []
        for name, add in parts.items():
            is_open = name not in ("Edit", "Camera path", "Help")
            self._folders.append(gui.add_folder(name, expand_by_default=is_open))
            with self._folders[-1]:
                add()

    def _add_edits(self, opened: Opened) -> None:
        self._edits = EditControls(self._browsing, opened)

    def _add_display(self, gui: viser.GuiApi, opened: Opened) -> None:
        session = self._browsing.session
        scene = opened.renderable if isinstance(opened.renderable, GaussianScene) else None
        lacking = {
            "error": not len(views_of(opened)),
            "motion": scene is None,
            "filled": not shows_filled(opened),
        }
        layers = [name for name in LAYERS if not lacking.get(name)]
        if session.look.layer not in layers:
            session.change(layer="colour")
        hint = "error: against the truth, at a camera of the capture"
        layer = gui.add_dropdown("What", layers, initial_value=session.look.layer, hint=hint)
        layer.on_update(lambda _: self._change(layer=layer.value))
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

    def _add_capture(self, gui: viser.GuiApi, opened: Opened) -> None:
        session = self._browsing.session
        names = views_of(opened).names
        cameras = gui.add_checkbox(
            "Cameras", False, hint="frusta with their images; click one to go there"
        )
        cameras.on_update(
            lambda _: self._frusta.show(opened) if cameras.value else self._frusta.remove()
        )
        compare = gui.add_checkbox(
            "Compare", session.look.comparing, hint="with the truth, on the right of the line"
        )
        compare.on_update(lambda _: self._change(comparing=bool(compare.value)))
        divide = gui.add_slider("Divide", 0.0, 1.0, 0.01, session.look.divide)
        divide.on_update(lambda _: session.change(divide=float(divide.value)))
        view = gui.add_dropdown("Image", (NEAREST, *names))
        session.change(view=None)

        def choose(_: Any) -> None:
            index = None if view.value == NEAREST else names.index(str(view.value))
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
        if session.eye is None:
            return
        stream = io.BytesIO()
        Image.fromarray(draw(session.opened, session.shot())).save(stream, "png")
        name = f"{session.opened.name}_{session.time:.3f}.png"
        self._browsing.client.send_file_download(name, stream.getvalue(), save_immediately=True)


def _add_time(gui: viser.GuiApi, browsing: Browsing) -> None:
    session = browsing.session
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
    hint = "1: as it was filmed"
    speed = gui.add_dropdown("Speed", SPEEDS, initial_value=f"{timeline.speed:g}", hint=hint)
    speed.on_update(lambda _: session.change_timeline(speed=float(speed.value)))
    browsing.time_slider = slider


def _add_help(gui: viser.GuiApi, opened: Opened) -> None:
    from dyngs.view.server import as_text

    gui.add_markdown(HELP)
    for note in opened.notes:
        gui.add_markdown(f"*{as_text(note)}*")


def add_image_controls(browsing: Browsing, network: PeopleNetwork) -> None:
    """Add the choice of the images that a network predicts the person from."""
    client = browsing.client
    person = browsing.loaded.name
    names = (_NONE, *network.images_of(person))
    hint = f"none: {network.num_images} that see much of the person"
    chosen = [
        client.gui.add_dropdown(f"Image {i + 1}", names, hint=hint) for i in range(MOST_IMAGES)
    ]

    def predict(_: Any) -> None:
        images = tuple(dict.fromkeys(str(one.value) for one in chosen if one.value != _NONE))
        note = client.add_notification("Predicting", person, loading=True)

        def work() -> None:
            try:
                opened = network.predict(person, images)
            finally:
                note.remove()
            browsing.loaded = opened
            browsing.session.show(opened)  # from the same camera
            browsing.notify("Predicted", opened.notes[-1])

        browsing.session.ask(work)

    client.gui.add_button("Predict").on_click(predict)


def add_path_controls(browsing: Browsing) -> None:
    gui = browsing.client.gui
    session = browsing.session
    recorded = [Recording()]
    status = gui.add_markdown("no keyframes yet")
    hint = "from the keyframe that is added to the next one"
    seconds = gui.add_slider("Seconds", 0.1, 20.0, 0.1, 2.0, hint=hint)

    def record(**changes: Any) -> None:
        recorded[0] = recording = replace(recorded[0], **changes)
        count = len(recording)
        length = f"{counted(count, 'keyframe')}, {recording.duration:.1f} s" if count else ""
        status.content = length or "no keyframes yet"

    def add(_: Any) -> None:
        if session.eye is not None:
            time = None if session.opened.renderable.is_static else session.time
            keyframe = Keyframe(session.eye.camera(), time, float(seconds.value))
            record(keyframes=(*recorded[0].keyframes, keyframe))

    def save(_: Any) -> None:
        recording = recorded[0]
        if not len(recording):
            browsing.notify("No path", "Add a keyframe first.")
            return
        first = recording.keyframes[0].camera
        # as videos need it
        size = first.width // 2 * 2, first.height // 2 * 2
        text = recording.document(size, FPS, session.opened)
        browsing.client.send_file_download(FILE_NAME, text.encode(), save_immediately=True)

    gui.add_button("Add keyframe", hint="this camera, at this time").on_click(add)
    remove = gui.add_button("Remove last")
    remove.on_click(lambda _: record(keyframes=recorded[0].keyframes[:-1]))
    loop = gui.add_checkbox("Back to the first", False)
    loop.on_update(lambda _: record(loops=bool(loop.value)))
    gui.add_button("Preview").on_click(lambda _: session.preview(recorded[0]))
    hint = f"{FILE_NAME}, for: dyngs render RUN --path {FILE_NAME}"
    gui.add_button("Save path", hint=hint).on_click(save)


# A person: played motions, the rest pose, and poses by the angles of the main joints.

AS_CAPTURED, AT_REST, BY_SLIDERS = "as captured", "rest pose", "pose by sliders"
_BOTH_SIDES = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
MAIN_JOINTS = (
    *("pelvis", "spine1", "spine3", "neck", "head"),
    *(f"{side}_{joint}" for joint in _BOTH_SIDES for side in ("left", "right")),
)
"""Joints with sliders."""
MOTION_SUFFIXES = (".npz", ".bvh", ".glb", ".gltf", ".vrma")
_MOST_MOTIONS = 500

Angles = Mapping[str, tuple[float, float, float]]
"""Degrees about x, y and z, in this order, of joints by name; those that are missing are at
rest."""


def add_person_controls(browsing: Browsing, motions: Mapping[str, Path]) -> None:
    """Add the motion picker, for files by name, and the sliders of the pose."""
    gui = browsing.client.gui
    session = browsing.session
    angles: dict[str, tuple[float, float, float]] = {}
    motion = gui.add_dropdown("Motion", (AS_CAPTURED, AT_REST, BY_SLIDERS, *motions))
    hint = "in motions of files, feet on the floor do not slide"
    feet = gui.add_checkbox("Keep feet", False, hint=hint)
    joint = gui.add_dropdown("Joint", MAIN_JOINTS, initial_value="left_shoulder")
    sliders = [
        gui.add_slider(axis, -180.0, 180.0, 1.0, 0.0, hint=f"degrees about {axis}")
        for axis in "xyz"
    ]

    def play(_: Any = None) -> None:
        choice = str(motion.value)
        chosen = dict(angles)
        keep = bool(feet.value)

        def work() -> None:
            session.show(in_motion(browsing.loaded, choice, motions, chosen, keep_feet=keep))

        session.ask(work, "pose")

    def pick(_: Any) -> None:
        shown = angles.get(str(joint.value), (0.0, 0.0, 0.0))
        for slider, value in zip(sliders, shown, strict=True):
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
    feet.on_update(play)
    joint.on_update(pick)
    for slider in sliders:
        slider.on_update(turn)
    gui.add_button("All joints at rest").on_click(reset)


def motion_files(path: Path | None) -> dict[str, Path]:
    """Return the motion files in a folder, or the file itself, by name; empty for None. Raises
    DyngsError."""
    if path is None:
        return {}
    if path.is_file():
        return {path.name: path}
    if not path.is_dir():
        raise DyngsError(f"--motion {path}: no such file or folder")
    found = sorted(file for file in path.rglob("*") if file.suffix.lower() in MOTION_SUFFIXES)
    if not found:
        raise DyngsError(f"--motion {path}: no motion files there ({', '.join(MOTION_SUFFIXES)})")
    return {file.relative_to(path).as_posix(): file for file in found[:_MOST_MOTIONS]}


def in_motion(
    opened: Opened,
    choice: str,
    files: Mapping[str, Path],
    angles: Angles,
    *,
    keep_feet: bool = False,
) -> Opened:
    """Return the person of ``opened`` in a motion: as captured, of a file, or in the rest pose with
    joints rotated by the ``angles`` of sliders.

    With ``keep_feet`` feet on the floor do not slide in the motion of a file.

    Raises DyngsError: the file cannot be read.
    """
    from scipy.spatial.transform import Rotation

    if choice == AS_CAPTURED:
        return opened
    if choice in files:
        return opened.in_motion(files[choice], keep_feet=keep_feet)
    person = avatar_of(opened.renderable)
    if person is None:
        raise ValueError("only a person can be posed")
    clip = rest_clip(person.clip, person.skeleton.joints, person.skeleton.parents)
    poses = clip.poses.clone()
    rows = SMPLX_ROWS[poses.shape[1]]
    for name, turns in angles.items() if choice == BY_SLIDERS else ():
        row = rows.index(JOINT_NAMES.index(name))
        rest = Rotation.from_rotvec(poses[0, row].double().cpu().numpy())
        turned = rest * Rotation.from_euler("xyz", turns, degrees=True)
        poses[0, row] = torch.from_numpy(turned.as_rotvec()).to(poses)
    return replace(opened, renderable=person.playing(replace(clip, poses=poses)), as_captured=False)


# The cameras of a capture, as frusta with their images.

_COVERS = 1.5
"""Distance, in depths of a frustum, within which its image would cover what is behind."""
MOST_FRUSTA = 120
"""Frusta that are shown at most, spread evenly over the cameras."""
_SIZE, _OF_SPREAD = 0.05, 0.15
"""Depth of a frustum at most, relative to the distance of the cameras from what they see, and from
their middle: those of a video stand close together."""


class Frusta:
    """Frusta of one browser."""

    def __init__(self, browsing: Browsing) -> None:
        self._browsing = browsing
        self._handles: list[tuple[Any, np.ndarray, float]] = []
        browsing.on_move = self.hide_what_covers

    def show(self, opened: Opened) -> None:
        """Add the frusta, image by image, as the thread that draws finds time."""
        self.remove()
        handles = self._handles
        poses = views_of(opened).poses
        size = frustum_size(poses, viewpoint_of(opened).extent)
        views = distinct(poses)
        for index in (views[i] for i in evenly_spaced(len(views), MOST_FRUSTA)):
            self._browsing.session.ask(lambda index=index: self._add(opened, index, size, handles))

    def remove(self) -> None:
        handles = self._handles
        self._handles = []
        for handle, _, _ in handles:
            handle.remove()

    def hide_what_covers(self) -> None:
        """Hide the frusta that the browser's camera stands in, and all where the image is of
        another camera."""
        session = self._browsing.session
        eye = session.eye
        is_elsewhere = session.shown_view is not None
        if eye is None:
            return
        for handle, position, size in list(self._handles):
            distance = float(np.linalg.norm(position - eye.position))
            is_seen = not is_elsewhere and distance >= _COVERS * size
            if handle.visible != is_seen:
                handle.visible = is_seen

    def _add(self, opened: Opened, index: int, size: float, handles: list[Any]) -> None:
        if handles is not self._handles:
            return  # removed meanwhile
        shown = views_of(opened)
        camera = shown.cameras[index]
        wxyz, position = pose_of(camera)
        image = None
        if shown.thumbnails is not None:
            image = to_uint8(shown.thumbnails[index].composite(opened.background).numpy())
        handle = self._browsing.client.scene.add_camera_frustum(
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
        self.hide_what_covers()

    def _go(self, index: int) -> None:
        browsing = self._browsing
        opened = browsing.session.opened
        time = views_of(opened).times[index]
        browsing.go_to(index)
        if time is not None and not opened.renderable.is_static:
            browsing.session.set_time(time)
            if browsing.time_slider is not None:
                browsing.time_slider.value = round(time, 3)


def distinct(poses: np.ndarray) -> list[int]:
    """Return the indices of the first view from each pose of (V, 4, 4), ascending: a fixed camera
    is shown once."""
    relative = poses.copy()
    relative[:, :3, 3] /= np.abs(poses[:, :3, 3]).max(initial=0.0) or 1.0
    _, first = np.unique(relative.round(6).reshape(len(poses), -1), axis=0, return_index=True)
    return sorted(first.tolist())


def frustum_size(poses: np.ndarray, extent: float) -> float:
    """Return the depth of the frusta of poses (V, 4, 4), world units; ``extent`` is the distance of
    what they see."""
    centers = centers_of(poses)
    spread_out = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    stand_together = spread_out <= 1e-4 * extent
    return _SIZE * extent if stand_together else min(_SIZE * extent, _OF_SPREAD * spread_out)
