"""Pages in a browser, and scenes in pages of others: that they play by themselves, show what dyngs
draws, and obey, whatever the server does."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Browser, Page, needs_browser
from moving_scene import camera, still_scene, write_moving_run
from numpy.typing import NDArray
from scaled_files import FACTORS, scaled
from scene_kinds import KINDS, onlooker, scene_of_kind
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
from small_triangles import bent
from small_triangles import camera as before_triangles

from dyngs.baselines.triangles.scene import TriangleOptions, TriangleScene
from dyngs.cli import main
from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr, ssim
from dyngs.export.choose_path import select_view
from dyngs.export.html import scene_data
from dyngs.export.html.page import (
    ELEMENT,
    MOST_VIEWS,
    element_script,
    write_page,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.opened import OpenedScene, open_run, wrap_scene


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as started:
        yield started


def opened(browser: Browser, path: Path, width: int = 320, height: int = 240) -> Page:
    page = browser.open(path.as_uri(), width, height)
    page.wait_for("window.dyngs !== undefined")
    page.evaluate("dyngs.player.toggle(false)")
    return page


def assert_alike(
    page: Page, scene: GaussianScene, view: Cameras, options: RenderOptions, least: float = 38.0
) -> None:
    for time in (0.0, 0.4, 1.0):
        truth = scene.render(view, time, options=options, background=torch.ones(3)).rgb[0].detach()
        found = shown(page, view, time)
        assert ssim(found, truth) > 0.95
        assert psnr(found, truth) > least


@needs_browser
@pytest.mark.parametrize("kind", KINDS)
def test_a_page_shows_what_dyngs_draws(kind: str, browser: Browser, tmp_path: Path) -> None:
    scene = scene_of_kind(kind)
    view = large(onlooker())
    write(scene, tmp_path / "page.html", view)
    page = opened(browser, tmp_path / "page.html")
    assert_alike(page, scene, view, scene.options)
    assert page.errors == []
    assert page.requests == [(tmp_path / "page.html").as_uri()]
    page.close()


@needs_browser
@pytest.mark.parametrize(("texture", "degree"), [(0, 0), (1, 1), (3, 4)])
def test_triangles(texture: int, degree: int, browser: Browser, tmp_path: Path) -> None:
    patches = bent(12, seed=1, degree=degree)
    patches = patches.with_texture(texture) if texture else patches
    varied = patches.colours + 0.2 * torch.randn(
        patches.colours.shape, generator=torch.Generator().manual_seed(2)
    )
    options = TriangleOptions(near=0.1, segments=16, supersampling=4)
    scene = TriangleScene(
        replace(patches, colours=varied), 1.0, options, torch.tensor([1.0, 0.9, 0.8])
    )
    view = before_triangles(192, distance=5.0)
    write_page(opened_triangles(scene), tmp_path / "page.html", title="triangles", views=(view,))
    page = opened(browser, tmp_path / "page.html")
    truth = scene.render(view).rgb[0].detach().clamp(0, 1)
    found = shown(page, view, 0.0)
    # outlines differ by rounding: 16 or more samples of a pixel here, their places there
    assert psnr(found, truth) > 44
    assert float((found - truth).abs().median()) < 0.003
    assert page.errors == []
    page.close()


def opened_triangles(scene: TriangleScene) -> OpenedScene:
    return replace(wrap_scene(scene_of_kind("static")), renderable=scene, stated_up="-y")


@needs_browser
@pytest.mark.parametrize("mode", list(RasterizeMode))
def test_harmonics_and_modes(mode: RasterizeMode, browser: Browser, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    count = 60
    gaussians = Gaussians(
        torch.rand(count, 3, generator=generator) * 2 - 1,
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 3, generator=generator) * 3 - 4.5,
        torch.randn(count, generator=generator) * 2,
        torch.randn(count, 25, 3, generator=generator) * 0.3,
    )
    scene = StaticScene(gaussians=gaussians)
    options = RenderOptions(mode=mode, eps2d=0.5)
    view = large(camera(), 6)
    write(scene, tmp_path / "page.html", view, options=options)
    page = opened(browser, tmp_path / "page.html")
    assert_alike(page, scene, view, options)
    page.close()


@needs_browser
def test_time_and_camera_obey(browser: Browser, tmp_path: Path) -> None:
    scene = sliding_scene()
    path = tmp_path / "page.html"
    write(scene, path, large(camera(), 6), title="</script><b>& a 'scene' \"")
    page = opened(browser, path)
    assert page.evaluate("document.title") == "</script><b>& a 'scene' \""
    assert (
        page.evaluate("document.querySelector('#about h1').textContent")
        == "</script><b>& a 'scene' \""
    )
    page.evaluate("dyngs.player.seek(0)")
    first = settled(page)
    page.driven.fill("#time", "0.5")
    later = settled(page)
    assert changed(first, later)
    page.press("ArrowLeft")
    # five training times: one frame back
    assert page.evaluate("dyngs.player.time") == pytest.approx(0.25)
    page.press("ArrowRight")
    page.drag((160, 120), (220, 120))
    assert changed(later, turned := settled(page))
    page.scroll((160, 120), 300)
    assert changed(turned, nearer := settled(page))
    page.press("r")
    assert not changed(later, settled(page))
    page.resize(240, 320)
    page.driven.wait_for_timeout(300)
    assert page.evaluate("[dyngs.canvas.clientWidth, dyngs.canvas.clientHeight]") == [240, 320]
    assert changed(nearer, settled(page))
    page.press("Space")
    page.wait_for("dyngs.player.playing && dyngs.player.time > 0.05 && dyngs.player.time < 0.9")
    assert page.errors == []
    page.close()


@needs_browser
@pytest.mark.parametrize("most", [None, 9000])
def test_levels_are_drawn_as_by_dyngs(most: int | None, browser: Browser, tmp_path: Path) -> None:
    scene, view = levels_of_a_cloud(tmp_path / "page", most)
    with served(tmp_path / "page") as server:
        page = browser.open(server.address, 320, 240)
        page.wait_for("window.dyngs !== undefined")
        for factor in (1.0, 30.0):
            one = from_afar(view, factor)
            assert psnr(shown(page, one, 0.0), scene.render(one).rgb[0]) > 38
            drawn = sum(scene.levels.count(block) for block in scene.levels.cut(one, most))
            assert drawn == (14_000 if most is None and factor == 1 else 3_500)
            cut = page.evaluate(
                "[...dyngs.renderer.motion.drawn].map((row) => dyngs.renderer.tree.countOf(row))"
            )
            assert sum(cut) == drawn
        assert page.errors == []
        assert all(request.startswith(server.address) for request in page.requests)
        assert len(page.requests) == (6 if most is None else 2)
        page.close()


def test_only_a_new_folder_is_written_and_no_moving_scene(tmp_path: Path) -> None:
    still = wrap_scene(still_scene())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(DyngsError, match="exists already"):
        write_page(still, tmp_path / "full", folder=True)
    with pytest.raises(DyngsError, match="need a static scene"):
        write_page(wrap_scene(sliding_scene()), tmp_path / "new", most=9, folder=True)
    assert [path.name for path in tmp_path.rglob("*")] == ["full", "mine"]


def test_a_page_names_no_host_and_allows_none(tmp_path: Path) -> None:
    write(still_scene(), tmp_path / "page.html", camera())
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.findall(
        r"(?:https?:)?//[\w.-]+\.\w+|<(?!dyngs-scene )\w+[^<>]*\bsrc=|@import|\burl\(", text
    )
    policy = re.findall(r'Content-Security-Policy" content="([^"]+)"', text)[0]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert json.loads(text.split('id="header">')[1].split("</script>")[0])["count"] == 5


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("moving")))


def test_a_page_begins_at_a_camera_of_the_capture(moving_run: OpenedScene, tmp_path: Path) -> None:
    written = write_page(moving_run, tmp_path / "a.html", time=0.25)
    header = written.header
    assert written.notes == ()
    assert written.num_bytes == (tmp_path / "a.html").stat().st_size
    assert (header["moves"], header["time"], header["background"]) == (True, 0.25, [1.0, 1.0, 1.0])
    assert header["seconds"] >= 1.0
    assert 2 <= len(header["views"]) <= 1 + MOST_VIEWS
    assert all((view["width"], view["height"]) == (16, 16) for view in header["views"])
    assert header["up"] == pytest.approx([0, 0, 1], abs=0.3)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>run</title>" in text
    written = write_page(replace(moving_run, stated_up="-y"), tmp_path / "a.html")
    assert written.header["up"] == [0.0, -1.0, 0.0]


def test_title_and_first_view_are_chosen(moving_run: OpenedScene, tmp_path: Path) -> None:
    run = moving_run.path
    path = tmp_path / "a.html"
    assert main(["export", str(run), "--out", str(path), "--view", "2", "--title", "A <b>"]) == 0
    text = path.read_text(encoding="utf-8")
    assert "<title>A &lt;b&gt;</title>" in text
    wanted = select_view(moving_run.capture, "2").cam_from_world
    header = write_page(moving_run, path, view="2").header
    found = np.array(header["views"][0]["camFromWorld"]).reshape(4, 4)
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    assert main(["export", str(run), "--out", str(path), "--view", "none"]) == 2


@needs_browser
def test_fingers_and_the_button_move_the_camera(browser: Browser, tmp_path: Path) -> None:
    write_page(wrap_scene(still_scene()), tmp_path / "a.html")
    page = browser.open((tmp_path / "a.html").as_uri(), 320, 240, touch=True)
    page.wait_for("window.dyngs?.renderer")
    screen = page.driven.context.new_cdp_session(page.driven)

    def swipe(*fingers: tuple[int, int, int, int]) -> None:
        before = [{"x": a, "y": b, "id": i} for i, (a, b, _, _) in enumerate(fingers)]
        after = [{"x": c, "y": d, "id": i} for i, (_, _, c, d) in enumerate(fingers)]
        for kind, points in (("Start", before), ("Move", after), ("End", [])):
            screen.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})

    def camera() -> dict[str, Any]:
        names = "({ yaw, target, distance, index }) => ({ yaw, target, distance, index })"
        return page.evaluate(f"({names})(dyngs.camera)")

    start = camera()
    swipe((100, 120, 160, 120))
    turned = camera()
    assert turned["yaw"] != start["yaw"]
    assert (turned["target"], turned["distance"]) == (start["target"], start["distance"])
    swipe((100, 120, 120, 150), (200, 120, 220, 150))
    moved = camera()
    assert moved["target"] != turned["target"]
    assert moved["distance"] == pytest.approx(turned["distance"], rel=0.2)
    swipe((140, 120, 100, 120), (180, 120, 220, 120))
    assert camera()["distance"] == pytest.approx(moved["distance"] / 3)
    page.driven.tap("#next")
    assert camera()["index"] == 1
    page.driven.tap("#help")
    keys = page.driven.inner_text("#keys")
    assert "next, previous camera" in keys
    assert "play" not in keys  # nothing moves
    assert page.errors == []
    page.close()


@pytest.mark.parametrize("factor", [1e-7, *FACTORS])
def test_a_page_begins_with_the_same_view_in_any_unit(factor: float, tmp_path: Path) -> None:
    headers = []
    for unit in (1.0, factor):
        opened = wrap_scene(StaticScene(gaussians=scaled(still_scene().gaussians, unit)))
        headers.append(write_page(opened, tmp_path / "a.html").header)
    wanted, found = headers
    np.testing.assert_allclose(np.array(found["target"]) / factor, wanted["target"], atol=1e-5)
    for a, b in zip(found["views"], wanted["views"], strict=True):
        pose = np.array(a["camFromWorld"]).reshape(4, 4)
        pose[:3, 3] /= factor
        np.testing.assert_allclose(pose, np.array(b["camFromWorld"]).reshape(4, 4), atol=1e-4)


def settled(page: Page) -> NDArray[np.uint8]:
    """The canvas once it is drawn with all pixels, without what lies over it."""
    page.driven.wait_for_timeout(50)
    page.evaluate("dyngs.drawNow(1)")
    page.driven.wait_for_timeout(50)
    return page.screenshot("#canvas")[62:138]


def changed(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> bool:
    return a.shape != b.shape or bool(np.abs(a.astype(int) - b).max() > 40)


@needs_browser
def test_a_long_clip_is_fetched_as_it_is_played(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of_kind("hexplane")
    view = large(onlooker())
    monkeypatch.setattr(scene_data, "CHUNK_BYTES", 60)
    scene = replace(scene, background=torch.ones(3))
    written = write_page(
        replace(wrap_scene(scene), stated_up="-y"), tmp_path / "clip", views=(view,), folder=True
    )
    curves = written.header["curves"]
    count = -(-(curves["points"] - 3) // curves["chunk"])
    assert count == 8
    assert len(list((tmp_path / "clip").glob("*.bin"))) == count
    with served(tmp_path / "clip") as server:
        server.failing |= {"7.bin": ["503"], "6.bin": ["silent"]}
        page = browser.open(None, 320, 240)
        page.driven.emulate_media(reduced_motion="reduce")  # it does not play by itself
        page.driven.goto(server.address)
        page.wait_for("window.dyngs !== undefined")
        page.wait_for("dyngs.renderer.motion.drivers.chunks.held.size === 3")
        assert not page.evaluate("dyngs.player.playing")
        asked = [name for name in server.asked if name.endswith(".bin")]
        assert (asked[0], sorted(asked)) == ("0.bin", ["0.bin", "1.bin", "2.bin"])
        assert_alike(page, scene, view, scene.options)
        assert server.asked.count("7.bin") == 2
        assert page.evaluate("dyngs.renderer.motion.drivers.chunks.held.size") == 6
        # the picture stands while a part is fetched, and the clock with it
        page.evaluate("dyngs.release(), dyngs.player.seek(6.5 / 8), dyngs.play()")
        page.driven.wait_for_timeout(300)
        assert page.evaluate("dyngs.player.time") == pytest.approx(6.5 / 8)
        page.wait_for("dyngs.player.time !== 6.5 / 8")
        assert "6.bin" in server.asked
        page.close()


POLICY = "default-src 'none'; script-src 'self'; connect-src 'self'; style-src 'self'; "
POLICY += "require-trusted-types-for 'script'; trusted-types 'none'"


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
    head += (
        f'<link rel="stylesheet" href="site.css"><script src="{ELEMENT}"></script>'
        f'<script src="{ELEMENT}"></script>'
    )
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
def test_broken_scenes_show_one_line_in_their_element(browser: Browser, site: Path) -> None:
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
