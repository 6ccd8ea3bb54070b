"""Pages of scenes for tests: written, put on a web server that may cut off, and looked at."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, Literal

import numpy as np
import torch
from browser import Page
from moving_scene import camera, moving_scene, sliding_nodes
from PIL import Image
from splat_scenes import cloud

from dyngs.core.camera import Cameras
from dyngs.export.html.page import ELEMENT, PAGE, WrittenPage, write_page
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.opened import wrap_scene

Failure = Literal["cut", "404", "503", "silent", "damaged"]


def write(
    scene: GaussianScene,
    path: Path,
    view: Cameras,
    title: str = "a scene",
    options: RenderOptions | None = None,
) -> WrittenPage:
    scene = replace(scene, options=options or scene.options, background=torch.ones(3))
    return write_page(replace(wrap_scene(scene), stated_up="-y"), path, title=title, views=(view,))


def shown(page: Page, view: Cameras, time: float, which: int = 0) -> torch.Tensor:
    """Return the image (H, W, 3) that a scene of the page draws."""
    ((fx, _, cx), (_, fy, cy), _) = view.intrinsics[0].tolist()
    asked = {
        "camFromWorld": view.cam_from_world[0].flatten().tolist(),
        "intrinsics": [fx, fy, cx, cy],
    }
    asked |= {"width": view.width, "height": view.height, "time": time}
    show = "([view, which]) => document.querySelectorAll('dyngs-scene')[which].show(view)"
    address: str = page.evaluate(show, [asked, which])
    image = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")
    return torch.from_numpy(np.asarray(image).astype(np.float32) / 255)


def wait_for_line(page: Page, part: str, which: int = 0) -> str:
    """Wait until the message of a scene contains ``part``, and return the message."""
    line = f"document.querySelectorAll('dyngs-scene')[{which}].parts.message.textContent"
    page.wait_for(f"{line}.includes({part!r})")
    return str(page.evaluate(line))


def large(view: Cameras, factor: int = 4) -> Cameras:
    """The same view with more pixels."""
    scale = torch.tensor([factor, factor, 1.0])[:, None]
    return Cameras(
        view.cam_from_world, view.intrinsics * scale, view.width * factor, view.height * factor
    )


@dataclass
class Server:
    """A folder on a web server.

    Attributes:
        address: of the folder, with a slash at its end.
        failing: by name of a file how its next answers fail, in turn; then it arrives.
        asked: names of the files that were asked for, in turn.
    """

    address: str
    failing: dict[str, list[Failure]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)


class Served(SimpleHTTPRequestHandler):
    def __init__(self, *args: Any, state: Server, **kwargs: Any) -> None:
        self.state = state
        super().__init__(*args, **kwargs)

    def send_head(self) -> Any:
        name = self.path.split("?")[0].strip("/")
        self.state.asked.append(name)
        failures = self.state.failing.get(name, [])
        if not failures:
            return super().send_head()
        failure = failures.pop(0)
        if failure in ("404", "503"):
            self.send_error(int(failure))
            return None
        data = Path(self.translate_path(self.path)).read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if failure == "silent":
            time.sleep(3)
        half = data[: len(data) // 2]
        return io.BytesIO(half + bytes(len(data) - len(half)) if failure == "damaged" else half)

    def log_message(self, format: str, *args: Any) -> None: ...


@contextmanager
def served(folder: Path) -> Iterator[Server]:
    """Put a folder on a web server of this machine."""
    state = Server("")
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Served, directory=str(folder), state=state)
    ) as server:
        state.address = f"http://127.0.0.1:{server.server_port}/"
        Thread(target=server.serve_forever, daemon=True).start()
        yield state
        server.shutdown()


def levels_of_a_cloud(folder: Path, most: int | None = None) -> tuple[LevelScene, Cameras]:
    """Five blocks of ``BLOCK`` Gaussians or fewer."""
    gaussians = cloud(14_000, degree=1)
    still = StaticScene(
        gaussians=gaussians.replace(log_scales=gaussians.log_scales - 1), background=torch.ones(3)
    )
    view = large(camera(), 6)
    written = write_page(
        replace(wrap_scene(still), stated_up="-y"), folder, most=most, views=(view,), folder=True
    )
    assert written.num_bytes == sum(file.stat().st_size for file in folder.iterdir())
    blocks = [*(f"0-{i}.bin" for i in range(4)), "1-0.bin"]
    assert sorted(file.name for file in folder.iterdir()) == [*blocks, ELEMENT, PAGE]
    return LevelScene.from_scene(still, most), view


def from_afar(view: Cameras, factor: float) -> Cameras:
    pose = view.cam_from_world.clone()
    pose[0, 2, 3] *= factor
    return replace(view, cam_from_world=pose)


def sliding_scene() -> GaussianScene:
    """Five balls of which two go along x."""
    return moving_scene(sliding_nodes())
