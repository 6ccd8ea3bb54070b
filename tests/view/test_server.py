"""The viewer in a real browser, and what it does with messages that no browser sends."""

import json
import re
import socket
import string
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Browser, Page, missing
from moving_scene import write_moving_run
from PIL import Image

import dyngs
from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import ssim
from dyngs.export.edit.crop import screen_positions
from dyngs.training.events import Event, StepDone
from dyngs.view.server import (
    COOKIE,
    AccessPolicy,
    BrowserConnection,
    ServerOptions,
    Viewer,
    access_policy_for,
    enforce_access,
    escape_markdown,
    free_port,
    is_loopback,
    link_to,
    silence_viser,
)
from dyngs.view.session import Keyframe, Recording
from dyngs.view.source import open_source
from dyngs.view.training import TrainingView

pytest.importorskip("viser", reason="viser is not installed (pip install 'dyngs[view]')")

SIZE = (900, 480)
SEEN = (slice(160, 470), slice(5, 560))
"""Of the page: below the browser's message about software rendering, left of the controls."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    with Browser(timeout=30) as started:
        yield started


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def viewer(run: Path) -> Iterator[Viewer]:
    source = open_source(run)
    with Viewer(source, source.load(source.names[0]), ServerOptions()) as viewer:
        yield viewer


def until(is_so: Callable[[], bool], page: Page | None = None, seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end, "waited in vain"
        page.driven.wait_for_timeout(50) if page is not None else time.sleep(0.05)


def opened(viewer: Viewer, browser: Browser) -> tuple[Page, BrowserConnection]:
    """A page whose image is complete."""
    known = viewer.connections
    # viser draws fewer pixels where the browser is slow
    page = browser.open(f"{viewer.link}?fixedDpr=1", *SIZE)
    until(lambda: len(viewer.connections) > len(known), page)
    (connection,) = [one for one in viewer.connections if one not in known]
    settle(page, connection)
    return page, connection


def settle(page: Page, connection: BrowserConnection) -> None:
    """Wait until the controls are in their place, nothing is left to be drawn, and the page has
    shown it."""
    until(
        lambda: (
            connection.session.browser_camera is not None
            and connection.session.browser_camera.size[0] < SIZE[0]
        ),
        page,
    )
    until(lambda: connection.num_sent > 0 and connection.session.due() is None, page)
    page.driven.wait_for_timeout(600)
    for close in page.driven.locator(".mantine-Notification-closeButton").all():
        close.click()  # viser says, before the image, that there is no GPU
    until(lambda: connection.session.due() is None, page)
    # no longer dimmed, as before it is connected
    until(lambda: bool((page.screenshot()[-5, 300] >= 254).all()), page)


def rendered(run: Path, connection: BrowserConnection, folder: Path) -> np.ndarray:
    """Return the image that ``dyngs render`` draws along the path that the page would save."""
    session = connection.session
    assert session.browser_camera is not None
    recording = Recording((Keyframe(session.browser_camera.camera(), session.time),))
    folder.mkdir()
    path = folder / "path.json"
    path.write_text(recording.document(session.browser_camera.size, 30.0, session.opened))
    assert main(["render", str(run), "--path", str(path), "--out", str(folder / "out")]) == 0
    return np.asarray(Image.open(folder / "out" / "frame_0000.png").convert("RGB"))


def likeness(one: np.ndarray, other: np.ndarray) -> float:
    first, second = (torch.from_numpy(x.copy()).float() / 255 for x in (one, other))
    return ssim(first, second)


def test_the_page_shows_what_render_draws_at_every_time(
    viewer: Viewer, browser: Browser, run: Path, tmp_path: Path
) -> None:
    page, connection = opened(viewer, browser)
    first = page.screenshot()
    truth = rendered(run, connection, tmp_path / "first")
    assert likeness(first[SEEN], truth[SEEN]) > 0.95
    slider = page.driven.get_by_role("slider").first
    slider.focus()
    page.press("End")
    until(lambda: connection.session.time == 1.0, page)
    settle(page, connection)
    last = page.screenshot()
    later = rendered(run, connection, tmp_path / "last")
    assert likeness(last[SEEN], later[SEEN]) > 0.95
    assert likeness(last[SEEN], first[SEEN]) < likeness(last[SEEN], later[SEEN])
    assert np.abs(later[SEEN].astype(int) - truth[SEEN]).mean() > 0.1  # something has moved
    assert page.errors == []
    # no other host
    assert {address.split("/")[2] for address in page.requests} == {viewer.link.split("/")[2]}
    page.close()


def test_two_browsers_have_cameras_of_their_own_and_one_may_go(
    viewer: Viewer, browser: Browser
) -> None:
    (one, first), (two, second) = opened(viewer, browser), opened(viewer, browser)
    threads = threading.active_count()
    before = second.session.browser_camera
    one.drag((300, 300), (380, 330))
    until(
        lambda: first.session.browser_camera is not None and first.session.browser_camera != before,
        one,
    )
    assert before is not None
    assert second.session.browser_camera is not None
    assert second.session.browser_camera.position == pytest.approx(before.position)
    for page in (one, two):
        page.click("text=Play")
    sent = second.num_sent
    until(lambda: second.num_sent > sent + 3, two)
    one.close()  # while it gets images
    until(lambda: len(viewer.connections) == 1, two)
    sent = second.num_sent
    until(lambda: second.num_sent > sent + 3, two)
    assert viewer.drawer.sessions == (second.session,)
    assert first.session.closed
    assert two.errors == []
    two.close()
    until(lambda: not viewer.connections)
    assert viewer.drawer.sessions == ()
    assert threading.active_count() <= threads + 2  # viser's pool may have grown


def test_gaussians_are_selected_and_deleted_with_the_pointer(
    viewer: Viewer, browser: Browser
) -> None:
    page, connection = opened(viewer, browser)

    def choose(label: str, value: str) -> None:
        page.driven.get_by_role("combobox", name=label).click()
        page.driven.get_by_role("option", name=value).click()
        page.driven.wait_for_timeout(300)

    choose("Background", "black")
    until(lambda: connection.session.display.background == (0, 0, 0), page)
    for folder in ("Show", "Time", "Capture", "Edit"):  # closes all but Edit
        page.driven.get_by_text(folder, exact=True).first.click()
    camera = connection.session.browser_camera
    assert camera is not None
    width, height = camera.size
    choose("Tool", "rectangle")
    page.driven.keyboard.down("Shift")
    page.drag((2, 2), (width - 2, height - 2))
    page.driven.keyboard.up("Shift")
    page.driven.wait_for_selector("text=5 selected")
    choose("Tool", "sphere")
    page.driven.keyboard.down("Control")
    balls = connection.session.opened.scene.at(0.0).means.numpy()
    x, y = screen_positions(balls, camera.camera())[2] * (width, height)
    page.driven.mouse.click(x, y)
    page.driven.keyboard.up("Control")
    page.driven.wait_for_selector("text=3 selected")  # another ball passes there
    assert connection.session.browser_camera == camera  # the pointer did not orbit
    page.driven.get_by_role("button", name="Delete selected").click()
    page.driven.wait_for_selector("text=2 of 5 Gaussians remaining")
    page.driven.get_by_role("button", name="Undo").click()
    page.driven.wait_for_selector("text=5 of 5 Gaussians remaining")
    assert page.errors == []
    page.close()


def test_a_training_is_paused_and_resumed_on_its_page(
    browser: Browser, still: Path, tmp_path: Path
) -> None:
    links: list[str] = []
    steps: list[int] = []
    resumed = threading.Event()

    def watch(event: Event) -> None:
        if isinstance(event, StepDone):
            steps.append(event.step)
            resumed.wait(0.2)  # leaves time for clicks

    settings = [f"data.root={still}", f"run.dir={tmp_path / 'run'}", "train.steps=150"]
    config = dyngs.load_config("static", [*settings, "init.num_random=40"])
    with TrainingView(
        config, ServerOptions(), links.append, lambda: {"step": f"{steps[-1]}"}
    ) as view:
        work = {"listeners": [watch, view]}
        thread = threading.Thread(target=dyngs.train, args=(config,), kwargs=work, daemon=True)
        thread.start()
        until(lambda: bool(links))
        page = browser.open(links[0].removeprefix("viewer: "), *SIZE)
        page.click("text=Pause training")
        page.driven.wait_for_selector("text=Resume training")
        page.driven.wait_for_timeout(300)
        paused = steps[-1]
        page.driven.wait_for_timeout(500)
        assert steps[-1] == paused
        page.click("text=Resume training")
        resumed.set()
        until(lambda: not thread.is_alive(), page)
        page.driven.wait_for_selector("text=step: 150")
        assert not page.driven.get_by_text("Pause training").is_visible()
        page.close()


SCRIPT = "<img src=x onerror=window.ran=1>"
FRAME = '<iframe srcdoc="<script>parent.ran=1</script>"></iframe>'
LINKS = "[a](javascript:window.ran=1) ![b](x) <a href=http://evil.example>c</a>"
LINKS += " http://evil.example www.evil.example me@evil.example"


def hostile_run(folder: Path) -> Path:
    """A run whose name, capture and names of views are HTML and Markdown."""
    made = write_moving_run(folder)
    run = made.rename(folder / f"*run* {SCRIPT}")
    root = (folder / "capture").rename(folder / f"capture {SCRIPT}")
    for split in ("train", "test"):
        file = root / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for i, frame in enumerate(document["frames"]):
            name = f"{split}/{i} {SCRIPT} {LINKS.replace('/', ':')}"
            (root / f"{frame['file_path']}.png").rename(root / f"{name}.png")
            frame["file_path"] = name
        file.write_text(json.dumps(document))
    config = run / "config.yaml"
    config.write_text(
        config.read_text().replace(f"root: {folder / 'capture'}", f"root: {json.dumps(str(root))}")
    )
    return run


def test_texts_of_strangers_are_shown_and_never_run(browser: Browser, tmp_path: Path) -> None:
    """Names of the run and of views, and the folder of the capture, in a note because it is
    gone."""
    run = hostile_run(tmp_path)
    other = write_moving_run(tmp_path / "other")
    config = other / "config.yaml"
    gone = f"/nowhere/{FRAME} {SCRIPT} {LINKS}"
    config.write_text(
        re.sub(r"root: .*", lambda _: f"root: {json.dumps(gone)}", config.read_text(), count=1)
    )
    for folder, wanted in ((run, "truth: "), (other, "capture not found")):
        source = open_source(folder)
        with Viewer(source, source.load(source.names[0]), ServerOptions()) as viewer:
            page = browser.open(viewer.link, *SIZE)
            until(lambda viewer=viewer: any(one.num_sent for one in viewer.connections), page)
            (connection,) = viewer.connections
            if folder == run:
                connection.session.change(comparing=True)
                connection.notify(SCRIPT, FRAME)
            else:
                page.click("text=Help")
            until(
                lambda page=page, wanted=wanted: (
                    wanted in page.evaluate("document.body.textContent")
                ),
                page,
            )
            page.driven.wait_for_timeout(500)
            text = page.evaluate("document.body.textContent").replace("\u200b", "")
            assert SCRIPT in text
            assert "![b](x) <a href=http:" in text
            assert page.evaluate("window.ran") is None
            assert (
                page.evaluate(
                    "document.querySelectorAll('iframe, img[src=x], a[href*=evil]').length"
                )
                == 0
            )
            assert not [
                address for address in page.requests if "evil" in address or address.endswith("/x")
            ]
            page.close()


def test_with_a_token_only_who_has_it_may() -> None:
    gate = AccessPolicy("secret")
    other = {"Host": "box:8080"}
    assert gate.refusal("/?token=secret", other) is None
    assert gate.refusal("/", other | {"Cookie": f"a=b; {COOKIE}=secret"}) is None
    for path, headers in (
        ("/", other),
        ("/?token=", other),
        ("/?token=wrong", other),
        ("/?token=s\u00e9cret", other),
        ("/", other | {"Cookie": f"{COOKIE}=wrong"}),
        ("/?token=secret", other | {"Origin": "http://evil.example"}),
    ):
        assert gate.refusal(path, headers) is not None
    assert "HttpOnly" in (gate.cookie("/?token=secret") or "")
    assert gate.cookie("/") is None
    assert AccessPolicy().cookie("/?token=x") is None


def test_only_a_server_for_others_has_a_token() -> None:
    assert [is_loopback(host) for host in ("localhost", "127.0.0.1", "::1")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "::", "192.168.1.7", "box")] == [False] * 4
    assert access_policy_for("127.0.0.1").token is None
    first = access_policy_for("0.0.0.0").token
    second = access_policy_for("0.0.0.0").token
    assert first is not None
    assert len(first) >= 24
    assert first != second


def test_a_free_port_is_found_and_a_taken_one_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        with pytest.raises(DyngsError, match=f"--port {taken}: cannot listen"):
            free_port("127.0.0.1", taken)
        assert free_port("127.0.0.1", None) != taken
    assert free_port("127.0.0.1", taken) == taken
    with pytest.raises(DyngsError, match="--host"):
        free_port("no.such.host.invalid", None)


@pytest.mark.parametrize(
    ("host", "more", "is_let_in"),
    [
        ("localhost:8080", {}, True),
        ("[::1]:8080", {"Origin": "http://[::1]:8080"}, True),
        ("127.0.0.2:8080", {}, True),
        ("evil.example:8080", {}, False),  # a name that was made to point here
        ("localhost:8080", {"Origin": "https://evil.example"}, False),  # opens a websocket
        ("localhost:8080", {"Origin": "null"}, False),
        ("", {}, False),
    ],
)
def test_this_machine_may_open_the_page_and_pages_of_others_may_not(
    host: str, more: dict[str, str], is_let_in: bool
) -> None:
    assert (AccessPolicy().refusal("/", {"Host": host} | more) is None) == is_let_in


def test_the_server_asks_the_gate() -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    port = free_port("127.0.0.1", None)
    with enforce_access(AccessPolicy("secret")), silence_viser():
        server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    version = f"viser-v{viser.__version__}"
    try:
        page = link_to("127.0.0.1", server.get_port())
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(page, timeout=5)
        assert refused.value.code == 403
        answer = urllib.request.urlopen(f"{page}?token=secret", timeout=5)
        assert answer.status == 200
        cookie = {"Cookie": answer.headers["Set-Cookie"].partition(";")[0]}
        socket_at = page.replace("http", "ws")
        with pytest.raises(InvalidStatus):
            connect(socket_at, subprotocols=[version])  # type: ignore[list-item]
        with connect(
            socket_at,
            additional_headers=cookie,
            subprotocols=[version],  # type: ignore[list-item]
        ) as opened_socket:
            assert opened_socket.recv(timeout=5)
    finally:
        with silence_viser():
            server.stop()
    assert link_to("::1", 80) == "http://[::1]:80/"
    assert link_to("box", 80, "secret") == "http://box:80/?token=secret"
    assert link_to("0.0.0.0", 80, "secret").endswith(f"{socket.gethostname()}:80/?token=secret")


@pytest.mark.parametrize("text", ["Größe 12", "a_b*c <i>x</i> [y](z) &lt;", string.punctuation])
def test_every_mark_of_others_is_escaped_and_nothing_else(text: str) -> None:
    shown = "".join(f"\\{c}" if c in string.punctuation else c for c in text)
    assert escape_markdown(text) == shown.replace("\\@", "\u200b\\@")
    assert escape_markdown("a\n\n<b>\x1b") == r"a \<b\>\\x1b"
    assert escape_markdown("http://x.y WWW.x") == "http\u200b\\:\\/\\/x\\.y WWW\u200b\\.x"
