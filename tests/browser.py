"""A real browser for tests of pages: Debian's chromium without a window, driven by playwright.

    @needs_browser
    def test_a_page() -> None:
        with Browser() as browser:
            page = browser.open("file:///tmp/page.html")
            page.wait_for("window.ready === true")
            image = page.screenshot()
            assert page.errors == [] and page.requests == ["file:///tmp/page.html"]

Several pages of one ``Browser`` are strangers to each other, as in private windows. WebGL runs on
the CPU (SwiftShader).
"""

from __future__ import annotations

import io
import os
import shutil
import time
from importlib.util import find_spec
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    import playwright.sync_api as playwright

Button = Literal["left", "middle", "right"]

CHROMIUM = (
    os.environ.get("DYNGS_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
)
"""The browser's program; None where there is none."""

ARGUMENTS = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--mute-audio",
)
"""WebGL without a GPU."""


def missing() -> str | None:
    """Return why no browser can be driven here; None where one can."""
    if CHROMIUM is None:
        return "no chromium here (apt install chromium, or DYNGS_CHROMIUM=PATH)"
    return (
        None if find_spec("playwright") else "playwright is not installed (pip install playwright)"
    )


needs_browser = pytest.mark.skipif(missing() is not None, reason=missing() or "")
"""For tests that start a ``Browser``."""


class Page:
    """One page in a browser, with its errors, warnings and requests.

    Attributes:
        errors: texts of errors in the console, of uncaught exceptions and of failed requests, in
            order.
        warnings: texts of warnings in the console.
        requests: addresses of all requests, that of the page itself first, and of websockets; data:
            and blob: are left out, since they reach no host.
        driven: the page as playwright has it, for all that has no method here.
    """

    def __init__(self, driven: playwright.Page, timeout: float) -> None:
        self.driven = driven
        self._timeout = timeout
        self.errors: list[str] = []
        self.warnings: list[str] = []
        self.requests: list[str] = []
        driven.set_default_timeout(1000 * timeout)
        driven.on("console", self._heard)
        driven.on("pageerror", lambda error: self.errors.append(f"uncaught: {error.message}"))
        driven.on(
            "requestfailed",
            lambda request: self.errors.append(f"failed: {request.url} ({request.failure})"),
        )
        driven.on("request", lambda request: self._asked(request.url))
        driven.on("websocket", lambda socket: self._asked(socket.url))

    def wait_for(self, expression: str, timeout: float | None = None) -> None:
        """Return once a JavaScript ``expression`` is true. Raises TimeoutError after ``timeout`` s.

        Asked again from here: playwright's own wait_for_function evaluates the text inside the page
        from its second try on, which the content security policy of our pages forbids.
        """
        end = time.monotonic() + (self._timeout if timeout is None else timeout)
        while not self.driven.evaluate(expression):
            if time.monotonic() > end:
                raise TimeoutError(f"not true in time: {expression}")
            self.driven.wait_for_timeout(20)

    def evaluate(self, expression: str, argument: Any = None) -> Any:
        """Return the value of a JavaScript expression, or of a function of ``argument``; a promise
        is awaited."""
        return self.driven.evaluate(expression, argument)

    def screenshot(self, selector: str | None = None) -> NDArray[np.uint8]:
        """Return (H, W, 3) what is seen of the page, or of the element that a CSS ``selector``
        names."""
        png = (
            self.driven.screenshot()
            if selector is None
            else self.driven.locator(selector).screenshot()
        )
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def click(self, selector: str) -> None:
        """Click the element that a CSS ``selector`` names, or that has a text: ``text=Play``."""
        self.driven.click(selector)

    def press(self, key: str) -> None:
        """Press a key, by its name in the browser: "Space", "ArrowLeft", "r"."""
        self.driven.keyboard.press(key)

    def drag(
        self, start: tuple[float, float], end: tuple[float, float], button: Button = "left"
    ) -> None:
        """Drag the mouse from ``start`` to ``end``, CSS pixels of the page, with a button held."""
        mouse = self.driven.mouse
        mouse.move(*start)
        mouse.down(button=button)
        mouse.move(*end, steps=4)
        mouse.up(button=button)

    def scroll(self, place: tuple[float, float], amount: float) -> None:
        """Turn the mouse wheel by ``amount`` pixels, down where positive, at a ``place`` of the
        page."""
        self.driven.mouse.move(*place)
        self.driven.mouse.wheel(0, amount)

    def resize(self, width: int, height: int) -> None:
        """Give the page another size, CSS pixels."""
        self.driven.set_viewport_size({"width": width, "height": height})

    def close(self) -> None:
        """Close the page and forget its cookies, as one who leaves does."""
        self.driven.context.close()

    def _heard(self, message: playwright.ConsoleMessage) -> None:
        heard = {"error": self.errors, "warning": self.warnings}.get(message.type)
        if heard is not None:
            heard.append(message.text)

    def _asked(self, address: str) -> None:
        if not address.startswith(("data:", "blob:")):
            self.requests.append(address)


class Browser:
    """A running chromium; a context manager, so that it ends with the test.

    Args:
        timeout: s after which whatever is waited for has failed.
    """

    def __init__(self, timeout: float = 20.0) -> None:
        self.timeout = timeout

    def __enter__(self) -> Browser:
        from playwright.sync_api import sync_playwright

        self._manager = sync_playwright()
        started = self._manager.__enter__()
        try:
            # Tests may run as root, in containers, where chromium's sandbox does not start.
            self._chromium = started.chromium.launch(
                executable_path=CHROMIUM, args=list(ARGUMENTS), chromium_sandbox=False
            )
        except BaseException:
            self._manager.__exit__()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._chromium.close()
        self._manager.__exit__(kind, error, trace)

    def open(
        self, address: str | None, width: int = 640, height: int = 480, *, touch: bool = False
    ) -> Page:
        """Return a new page of ``width`` x ``height`` CSS pixels that has loaded ``address``; None:
        nothing yet.

        Args:
            address: http://... or file://...
            width, height: of what is seen of the page; a CSS pixel is one of the screenshot.
            touch: the screen is touched, as a phone's.
        """
        context = self._chromium.new_context(
            viewport={"width": width, "height": height}, has_touch=touch
        )
        page = Page(context.new_page(), self.timeout)
        if address is not None:
            page.driven.goto(address)
        return page
