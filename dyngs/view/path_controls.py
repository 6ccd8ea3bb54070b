"""Controls that record a camera path: keyframes with time, a preview, and the file for ``dyngs render --path``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dyngs.view.recording import Keyframe, Recording

if TYPE_CHECKING:
    from dyngs.view.server import Browsing

FPS = 30.0
FILE_NAME = "camera_path.json"


def add_path_controls(browsing: Browsing) -> None:
    """Add the controls of the path that this browser records."""
    gui, session = browsing.client.gui, browsing.session
    recorded = [Recording()]
    status = gui.add_markdown("no keyframes yet")
    seconds = gui.add_slider("Seconds", 0.1, 20.0, 0.1, 2.0, hint="from the keyframe that is added to the next one")

    def record(recording: Recording) -> None:
        recorded[0] = recording
        count, duration = len(recording), recording.duration if len(recording) else 0.0
        status.content = f"{count} keyframe{'s' * (count != 1)}, {duration:.1f} s" if count else "no keyframes yet"

    def add(_: Any) -> None:
        if session.eye is not None:
            time = None if session.viewed.is_static else session.time
            record(recorded[0].added(Keyframe(session.eye.camera(), time, float(seconds.value))))

    def save(_: Any) -> None:
        if not len(recorded[0]):
            notify_empty(browsing)
            return
        width, height = (2 * (side // 2) for side in recorded[0].keyframes[0].camera_size)  # as videos need it
        viewed = session.viewed
        text = recorded[0].turned_back(viewed.turned).document((width, height), FPS, viewed.world_offset)
        browsing.client.send_file_download(FILE_NAME, text.encode(), save_immediately=True)

    gui.add_button("Add keyframe", hint="this camera, at this time").on_click(add)
    gui.add_button("Remove last").on_click(lambda _: record(recorded[0].without_last()))
    loop = gui.add_checkbox("Back to the first", False)
    loop.on_update(lambda _: record(Recording(recorded[0].keyframes, bool(loop.value))))
    gui.add_button("Preview").on_click(lambda _: session.preview(recorded[0]))
    gui.add_button("Save path", hint=f"{FILE_NAME}, for: dyngs render RUN --path {FILE_NAME}").on_click(save)


def notify_empty(browsing: Browsing) -> None:
    """Say that there is nothing to save."""
    browsing.client.add_notification("No path", "Add a keyframe first.", auto_close_seconds=5.0)
