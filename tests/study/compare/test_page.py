"""The page of a comparison in a real browser, with names of strangers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from browser import Browser, needs_browser

from dyngs.io.write import write_image
from dyngs.study.compare.page import page_text
from dyngs.study.compare.plan import Bench, Limit
from dyngs.study.compare.result import TRUTH, Result

NAME = "</script><img src=x onerror=window.ran=1>"


@needs_browser
def test_names_of_captures_views_and_models_are_shown_and_never_run(tmp_path: Path) -> None:
    bench = Bench(tmp_path / NAME.replace("/", ":"), tmp_path / "out", Limit(steps=1))
    result = Result(
        name="model", kind="static", num_views=1, psnr=1.0, ssim=1.0, lpips=None, psnr_foreground=None,
        psnr_moving=None, gaussians=1, mb=1.0, steps=1, seconds=1.0, views=((NAME, 1.0),), curve=(),
    )  # fmt: skip
    for name in (TRUTH, "model"):
        write_image(bench.image_path(name, 0), np.zeros((8, 8, 3), np.uint8))
    file = tmp_path / "page.html"
    file.write_text(
        page_text(bench, [result], {NAME: NAME}, (NAME, ["model"], [[NAME]], "")), encoding="utf-8"
    )
    with Browser() as browser:
        page = browser.open(file.as_uri())
        page.wait_for("document.querySelectorAll('canvas').length > 0")
        assert page.evaluate("document.body.textContent").count(NAME) >= 4
        assert page.evaluate("window.ran") is None
        assert page.evaluate("document.querySelectorAll('img[src=x]').length") == 0
        assert page.errors == []
