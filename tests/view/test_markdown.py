"""Text of others in Markdown: shown, never rendered. In a browser: test_server.py."""

from __future__ import annotations

import string

import pytest

from dyngs.view.markdown import as_text


@pytest.mark.parametrize(
    "text",
    ["plain words", "Größe 12", "a_b*c <i>x</i> [y](z) `q` {k} &lt; \\ #|~", string.punctuation],
)
def test_every_mark_is_escaped_and_nothing_else(text: str) -> None:
    shown = as_text(text)
    assert shown == "".join(f"\\{c}" if c in string.punctuation else c for c in text).replace(
        "\\@", "\u200b\\@"
    )


def test_it_is_one_line_without_addresses() -> None:
    assert as_text("a\n\n<b>\x1b") == r"a \<b\>\\x1b"
    assert as_text("http://x.y") == "http\u200b\\:\\/\\/x\\.y"
    assert as_text("WWW.x") == "WWW\u200b\\.x"
