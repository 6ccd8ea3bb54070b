"""How fast the viewer is: images drawn per second, and how many of them a browser shows.

    python benchmarks/viewer.py RUN... [--size 1000x600] [--seconds 6]

Opens each run or file in Debian's chromium without a window (WebGL on the CPU) and measures while
the mouse orbits, and, where something moves, while time plays. Needs `pip install '.[test]'` and
chromium. The browser takes time of the same cores: with a GPU, or a browser elsewhere, there is
more for the images.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from browser import Browser, Page, missing

from dyngs.view.server import BrowserConnection, ServerOptions, Viewer
from dyngs.view.source import load_first, open_source

WARM_UP = 3.0
"""Seconds before measuring, in which the image finds its size."""
COUNT_UPLOADS = """
window.uploads = 0;
for (const name of ["texImage2D", "texSubImage2D"]) {
  const upload = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    if (given.some((x) => x instanceof HTMLImageElement || x instanceof ImageBitmap)) window.uploads++;
    return upload.apply(this, given);
  };
}
"""
"""Counts images that reach the GPU of the page, real or not."""


def measure(
    page: Page, connection: BrowserConnection, act: Callable[[int], None], seconds: float
) -> tuple[float, float]:
    """Return the images per second that were sent and shown while ``act`` is called with 0, 1,
    ..."""
    for length in (WARM_UP, seconds):
        sent = connection.num_sent
        shown = page.evaluate("window.uploads")
        start = time.monotonic()
        count = 0
        while time.monotonic() < start + length:
            act(count)
            count += 1
    took = time.monotonic() - start
    return (connection.num_sent - sent) / took, (page.evaluate("window.uploads") - shown) / took


def rows(path: Path, size: tuple[int, int], seconds: float) -> list[str]:
    """Return a row of Markdown for each way of looking at a run or file."""
    source = open_source(path)
    found = []
    with (
        Viewer(source, load_first(source), ServerOptions()) as viewer,
        Browser(timeout=60) as browser,
    ):
        page = browser.open(None, *size)
        page.driven.add_init_script(COUNT_UPLOADS)
        page.driven.goto(viewer.link)
        while not viewer.connections or not viewer.connections[0].num_sent:
            page.driven.wait_for_timeout(100)
        (connection,) = viewer.connections
        mouse = page.driven.mouse
        middle = (size[0] // 4, size[1] // 2)

        def orbit(count: int) -> None:
            mouse.move(middle[0] + 3 * count % 100, middle[1] + count % 50)
            time.sleep(0.03)

        mouse.move(*middle)
        mouse.down()
        sent, shown = measure(page, connection, orbit, seconds)
        mouse.up()
        found.append(f"| {source.names[0]} | orbiting | {sent:.1f} | {shown:.1f} |")
        if connection.time_slider is not None:
            page.click("text=Play")
            sent, shown = measure(
                page, connection, lambda _: page.driven.wait_for_timeout(100), seconds
            )
            found.append(f"| {source.names[0]} | playing | {sent:.1f} | {shown:.1f} |")
    return found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="+", type=Path, metavar="RUN", help="run or file")
    parser.add_argument("--size", default="1000x600", help="of the page, px")
    parser.add_argument("--seconds", type=float, default=6.0)
    arguments = parser.parse_args()
    reason = missing()
    if reason is not None:
        sys.exit(reason)
    width, _, height = arguments.size.partition("x")
    print("| what | how | sent/s | shown/s |\n|---|---|---|---|")
    for path in arguments.paths:
        for row in rows(path, (int(width), int(height)), arguments.seconds):
            print(row, flush=True)


if __name__ == "__main__":
    main()
