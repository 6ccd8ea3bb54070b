"""Mutations of trees of dictionaries, lists and values: JSON and YAML."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from random import Random
from typing import Any

import yaml

from fuzz.blobs import NUMBERS, TEXTS, bytes_changed, text_changed

Place = tuple[Any, Any]
"""A dictionary or list of the tree, and a key or index of it."""

_RAW = re.compile(r'"RAW:([^"\\]*)"')
_AGAIN = "AGAIN:"
_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    10**19,
    -(10**30),
    1e-310,
    1e308,
    5e-324,
    math.nan,
    math.inf,
    -math.inf,
    [],
    {},
)
_DEEP = "[" * 3000 + "]" * 3000


def json_changed(data: bytes, rng: Random) -> bytes:
    """Return a JSON file after one mutation of a value, a key or the nesting, or of its text if it
    is broken."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return bytes_changed(data, rng)
    if rng.random() < 0.1:
        return text_changed(data, rng)
    return json_bytes(tree_changed(tree, rng))


def json_bytes(tree: object) -> bytes:
    """Return the tree as JSON; texts ``RAW:x`` become x without quotes, keys ``AGAIN:x`` a second
    x."""
    try:
        text = json.dumps(tree)
    except (TypeError, ValueError, RecursionError):
        return b"{}"
    text = text.replace(f'"{_AGAIN}', '"').replace('"DEEP"', _DEEP)
    return _RAW.sub(lambda match: match[1], text).encode()


def yaml_changed(data: bytes, rng: Random) -> bytes:
    """Return a YAML file after one mutation of a value, a key or its text."""
    if rng.random() < 0.5:
        return _yaml_text_changed(data, rng)
    try:
        tree = yaml.safe_load(data)
        return yaml.safe_dump(tree_changed(tree, rng), sort_keys=False).encode()
    except Exception:  # what was changed before may be anything
        return text_changed(data, rng)


def tree_changed(tree: Any, rng: Random) -> Any:
    """Change the tree in place at one node and return it."""
    places = list(_places(tree))
    if not places or rng.random() < 0.02:
        return rng.choice((*_VALUES, "text", [tree]))
    for _ in range(rng.choice((1, 1, 1, 2))):
        parent, key = rng.choice(places)
        if _has(parent, key):
            _change(parent, key, places, rng)
    return tree


def _change(parent: Any, key: Any, places: list[Place], rng: Random) -> None:
    value = parent[key]
    change = rng.randrange(10)
    if change == 0:
        del parent[key]
    elif change == 1 and isinstance(parent, dict):
        parent[rng.choice((_AGAIN + str(key), rng.choice(TEXTS), str(key) + "x"))] = rng.choice(
            _VALUES
        )
    elif change == 1:
        parent.insert(key, value)
    elif change == 2 and isinstance(value, list) and value:
        parent[key] = rng.choice((value[:-1], value * 2, value[::-1], [value], value[0]))
    elif change == 3:
        other, index = rng.choice(places)
        if _has(other, index) and not isinstance(other[index], (dict, list)):
            parent[key] = other[index]
    elif change == 4:
        parent[key] = rng.choice(("DEEP", "RAW:" + rng.choice(NUMBERS), "RAW:" + "9" * 5000))
    else:
        parent[key] = _other_value(value, rng)


def _other_value(value: Any, rng: Random) -> Any:
    if isinstance(value, str) and rng.random() < 0.7:
        text = rng.choice(TEXTS)
        return rng.choice((text, value + text, text + value, value.upper(), value[:-1]))
    if isinstance(value, (int, float)) and rng.random() < 0.6:
        factor = rng.choice((-1, 0, 2, 1e-3, 1e3, 1e9, 1e-9, 1e150, 1e-300))
        value = max(min(value, 1e100), -1e100) if isinstance(value, int) else value
        return rng.choice(
            (
                value * factor,
                value + 1,
                int(value) if math.isfinite(value) else 0,
                str(value),
                [value],
            )
        )
    return rng.choice(
        (*_VALUES, rng.choice(TEXTS), "RAW:" + rng.choice(NUMBERS), rng.randint(-3, 70_000))
    )


def _places(tree: Any) -> Iterator[Place]:
    """List the nodes of the tree; long lists of numbers are thinned out, so that names are chosen
    often enough."""
    if isinstance(tree, dict):
        for key, value in list(tree.items()):
            yield tree, key
            yield from _places(value)
    elif isinstance(tree, list):
        for index, value in enumerate(tree[:6]):
            yield tree, index
            yield from _places(value)


def _has(parent: Any, key: Any) -> bool:
    return key in parent if isinstance(parent, dict) else key < len(parent)


_TAGS = (
    "!!int abc",
    "!!float x",
    "!!python/object:os.system x",
    "!!binary x",
    "!!timestamp 1",
    "!!null 5",
    "!!set {a}",
)
_SCALARS = (
    "2024-02-30",
    "2024-01-01",
    "0x_",
    "0b",
    "0o9",
    "1:2:3",
    "*a",
    "&a b",
    "'",
    '"\\x"',
    "|",
    ">",
    "? a",
    "- b",
)
_SCALARS += (
    "\t",
    "\x07",
    "\x00",
    "\x1b[31m",
    "[[",
    "{",
    "{a: b, a: c}",
    "<<: *x",
    "#",
    "~",
    "yes",
    ".inf",
    ".nan",
    "9" * 5000,
)


def _yaml_text_changed(data: bytes, rng: Random) -> bytes:
    """Replace a value in the text by one that YAML reads in a special way."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(re.finditer(r"(?<=[:=]) *[^\n:=]+$", text, re.M))
    if not found or rng.random() < 0.4:
        return text_changed(data, rng)
    value = rng.choice(found)
    return (
        text[: value.start()] + " " + rng.choice((*_TAGS, *_SCALARS)) + text[value.end() :]
    ).encode("utf-8", "surrogateescape")


def override_changed(data: bytes, rng: Random) -> bytes:
    """Change a key or a value of overrides, one a line."""
    lines = data.decode("utf-8", "surrogateescape").split("\n")
    i = rng.randrange(len(lines))
    key, _, value = lines[i].partition("=")
    value = rng.choice(
        (value, rng.choice(NUMBERS), rng.choice(_SCALARS), rng.choice(_TAGS), rng.choice(TEXTS))
    )
    if rng.random() < 0.2:
        key = rng.choice(
            (
                key[:-1],
                key + ".x",
                "." + key,
                key.partition(".")[0],
                key.replace(".", ".."),
                "\u0663.a",
            )
        )
    lines[i] = (key + rng.choice(("=", "=", "=", "==", "")) + value).replace("\n", " ")
    return "\n".join(lines).encode(
        "utf-8", "backslashreplace" if "\ud800" in lines[i] else "surrogateescape"
    )
