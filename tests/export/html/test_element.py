"""Scenes in pages of others: drawn as by dyngs, under a strict policy, whatever the server does."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, Page, needs_browser
from moving_scene import camera, still_scene
from scene_pages import (
    Server,
    from_afar,
    large,
    levels_of_a_cloud,
    served,
    shown,
    sliding_scene,
    wait_for_line,
    write,
)

from dyngs.core.metrics import psnr
from dyngs.export.html.element import element_script
from dyngs.export.html.page import ELEMENT

POLICY = "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'self'; "
POLICY += "require-trusted-types-for 'script'; trusted-types 'none'"


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as started:
        yield started


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / ELEMENT).write_text(element_script(), encoding="utf-8")
    (tmp_path / "site.css").write_text(
        "dyngs-scene { width: 200px; height: 100px; } body { margin: 0 }", "utf-8"
    )
    return tmp_path


def page_with(
    browser: Browser, server: Server, site: Path, *elements: str, policy: str = POLICY
) -> Page:
    """Open a page of a site with these elements."""
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
    head += f'<link rel="stylesheet" href="site.css"><script src="{ELEMENT}"></script><script src="{ELEMENT}"></script>'
    (site / "site.html").write_text(f"<!DOCTYPE html>{head}{''.join(elements)}", encoding="utf-8")
    return browser.open(server.address + "site.html", 320, 240)


def wait_for_scene(page: Page, which: int = 0) -> None:
    scene = f"document.querySelectorAll('dyngs-scene')[{which}]"
    page.wait_for(f"{scene}.renderer && {scene}.parts.message.hidden")


@needs_browser
def test_several_scenes_stand_in_a_page_of_a_strict_site(browser: Browser, site: Path) -> None:
    view = large(camera())
    write(still_scene(), site / "still.html", view)
    write(sliding_scene(), site / "moving.html", view)
    levels, far = levels_of_a_cloud(site / "town")
    elements = [f'<dyngs-scene src="{src}" {more}></dyngs-scene>' for src, more in SOURCES]
    with served(site) as server:
        page = page_with(browser, server, site, *elements)
        for which, scene in enumerate((still_scene(), sliding_scene(), levels)):
            wait_for_scene(page, which)
            seen = from_afar(far, 30) if which == 2 else view
            truth = scene.render(seen, 0.4, background=far.intrinsics.new_ones(3)).rgb[0].detach()
            assert psnr(shown(page, seen, 0.4, which), truth) > 38
        assert page.errors == []
        assert (
            page.evaluate("[...document.querySelectorAll('dyngs-scene')].map((x) => x.clientWidth)")
            == [200] * 3
        )
        moving = "document.querySelectorAll('dyngs-scene')[1]"
        assert not page.evaluate(f"{moving}.player.playing")
        page.evaluate(f"{moving}.release(), {moving}.play()")
        page.wait_for(f"{moving}.player.playing && {moving}.player.time > 0.42")
        page.evaluate(f"{moving}.remove()")
        assert (
            page.evaluate("Object.keys(window).filter((name) => /dyngs|scene/i.test(name))") == []
        )
        page.close()


SOURCES = (("still.html", ""), ("./moving.html", ""), ("town", ""))


@needs_browser
def test_backgrounds_are_colours_of_the_site(browser: Browser, site: Path) -> None:
    write(still_scene(), site / "still.html", large(camera()))
    elements = [
        f'<dyngs-scene src="still.html" background="{x}"></dyngs-scene>'
        for x in ("teal", "transparent", "x y")
    ]
    (site / "site.css").write_text(
        "body { margin: 0; background: #102030 } dyngs-scene { height: 70px }", "utf-8"
    )
    with served(site) as server:
        page = page_with(browser, server, site, *elements)
        for which in (0, 1):
            wait_for_scene(page, which)
        assert 'background="x y" is no colour' in wait_for_line(page, "no colour", 2)
        image = page.screenshot()
        assert image[65, 5].tolist() == [0, 128, 128]
        assert image[135, 5].tolist() == [0x10, 0x20, 0x30]
        assert (image[70:140, 60:260] != (0x10, 0x20, 0x30)).any()
        page.evaluate("document.querySelector('dyngs-scene').setAttribute('background', '#ff0000')")
        page.driven.wait_for_timeout(100)
        wait_for_scene(page)
        assert page.screenshot()[65, 5].tolist() == [255, 0, 0]
        page.close()


@needs_browser
def test_what_cannot_be_shown_is_one_line_in_its_element(browser: Browser, site: Path) -> None:
    write(still_scene(), site / "good.html", camera())
    good = (site / "good.html").read_text(encoding="utf-8")
    head, rest = good.split('id="numbers">')
    numbers, tail = rest.split("</script>", 1)
    broken = {
        "other.html": ("<h1>Not here</h1>", "is no page that"),
        "half.html": (head + 'id="numbers">' + numbers[:48], "ends too early"),
        "short.html": (
            head + 'id="numbers">' + numbers[:48] + "</script>" + tail,
            "its numbers are damaged",
        ),
        "noise.html": (head + 'id="numbers">' + "%" * 40 + "</script>" + tail, "cannot be shown"),
        "header.html": (good.replace('id="header">{', 'id="header">{{'), "its header is damaged"),
        "views.html": (
            good.replace('"views": [{', '"views": [], "x": [{'),
            "its header is damaged",
        ),
        "huge.html": (good.replace('"rows": 5', '"rows": 5e15'), "cannot be shown"),
        "long.html": (good.replace('"rows": 5', '"rows": 4'), "its numbers are damaged"),
        "shader.html": (
            re.sub(r'"degree": \d', '"degree": "0\\\\n#error no"', good),
            "cannot be shown",
        ),
    }
    for name, (text, _) in broken.items():
        assert text != good
        (site / name).write_text(text, encoding="utf-8")
    sources = [*broken, "missing.html", "ftp://x/y.html", ""]
    parts = [*(part for _, part in broken.values()), "answered 404", "web server", 'no src="PAGE"']
    with served(site) as server:
        elements = [f'<dyngs-scene src="{src}"></dyngs-scene>' for src in sources]
        (site / "site.css").write_text("dyngs-scene { width: 80px; height: 8px; }", "utf-8")
        page = page_with(browser, server, site, *elements)
        for which, (src, part) in enumerate(zip(sources, parts, strict=True)):
            line = wait_for_line(page, part, which)
            assert line.startswith(f"{src or 'This scene'} cannot be shown: ")
            assert "\n" not in line
        assert [x for x in page.errors if "404" not in x] == []
        page.close()


@needs_browser
@pytest.mark.parametrize("failure", ["cut", "503", "silent"])
def test_a_page_that_did_not_arrive_is_asked_for_again(
    failure: str, browser: Browser, site: Path
) -> None:
    write(still_scene(), site / "still.html", camera())
    impatient = element_script().replace("SILENCE = 30000", "SILENCE = 400")
    assert impatient != element_script()
    (site / ELEMENT).write_text(impatient, encoding="utf-8")
    with served(site) as server:
        server.failing["still.html"] = [failure]  # type: ignore[list-item]
        page = page_with(browser, server, site, '<dyngs-scene src="still.html"></dyngs-scene>')
        assert "/still.html has not arrived (" in wait_for_line(page, "trying again")
        wait_for_scene(page)
        assert server.asked.count("still.html") == 2
        page.close()


@needs_browser
def test_lost_parts_hold_up_no_others_and_are_asked_for_again(browser: Browser, site: Path) -> None:
    scene, view = levels_of_a_cloud(site / "town")
    with served(site) as server:
        server.failing["town/1-0.bin"] = ["503", "damaged"]
        server.failing["town/0-2.bin"] = ["404", "cut", "404"]
        page = page_with(browser, server, site, '<dyngs-scene src="town/"></dyngs-scene>')
        assert "/town/1-0.bin has not arrived (the server answered 503" in wait_for_line(
            page, "trying again"
        )
        wait_for_line(page, "its numbers are damaged")
        page.wait_for("document.querySelector('dyngs-scene').renderer")
        line = wait_for_line(page, "/town/0-2.bin has not arrived")
        assert "trying again" in line
        # what is here is drawn, and the other parts arrive meanwhile
        page.wait_for("document.querySelector('dyngs-scene').renderer.motion.held.size === 4")
        assert np.ptp(page.screenshot("#canvas")) > 100
        assert psnr(shown(page, view, 0.0), scene.render(view).rgb[0]) > 38
        page.evaluate("document.querySelector('dyngs-scene').release()")
        wait_for_scene(page)
        assert [server.asked.count(f"town/{name}.bin") for name in ("1-0", "0-0", "0-2")] == [
            3,
            1,
            4,
        ]
        page.close()


@needs_browser
def test_a_scene_out_of_sight_is_not_asked_for(browser: Browser, site: Path) -> None:
    write(still_scene(), site / "still.html", camera())
    shutil.copy(site / "still.html", site / "below.html")
    with served(site) as server:
        (site / "site.css").write_text(
            "dyngs-scene { height: 200px } div { height: 2000px }", "utf-8"
        )
        elements = (
            '<dyngs-scene src="still.html"></dyngs-scene><div></div>',
            '<dyngs-scene src="below.html"></dyngs-scene>',
        )
        page = page_with(browser, server, site, *elements)
        wait_for_scene(page)
        assert "below.html" not in server.asked
        page.evaluate("window.scrollTo(0, 5000)")
        wait_for_scene(page, 1)
        # the wheel is for the article until the scene is clicked
        scene = "document.querySelectorAll('dyngs-scene')[1]"
        near = page.evaluate(f"{scene}.camera.distance")
        page.scroll((160, 120), -100)
        assert page.evaluate(f"{scene}.camera.distance") == near
        page.driven.mouse.click(160, 200)
        page.scroll((160, 200), -100)
        page.wait_for(f"{scene}.camera.distance < {json.dumps(near)}")
        page.close()


@needs_browser
def test_a_page_need_not_say_that_it_is_utf_8(browser: Browser, site: Path) -> None:
    write(sliding_scene(), site / "moving.html", large(camera()))
    element = '<dyngs-scene src="moving.html" style="width: 320px; height: 200px"></dyngs-scene>'
    (site / "old.html").write_bytes(
        f'<!DOCTYPE html><script src="{ELEMENT}"></script>{element}'.encode("ascii")
    )
    with served(site) as server:
        page = browser.open(server.address + "old.html", 400, 300)
        wait_for_scene(page)
        root = "document.querySelector('dyngs-scene').root"
        assert page.evaluate("document.characterSet") != "UTF-8"
        assert page.evaluate(f"{root}.getElementById('play').textContent") == "\u25b6"
        tops = f"[...{root}.querySelectorAll('#play, #seconds, #bar label, #bar select')].map((x) => x.offsetTop)"
        assert max(page.evaluate(tops)) - min(page.evaluate(tops)) < 8
        page.close()


def test_the_script_stands_alone() -> None:
    script = element_script()
    assert "</script" not in script
    assert "innerHTML" not in script
    assert "eval(" not in script
    assert script.rstrip().endswith("})();")
