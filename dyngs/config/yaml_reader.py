"""Read YAML presets and overrides as values with their origin (file and line).

YAML values stay text (``007``, ``2024-02-30``) because the schema decides their types. Invalid YAML
raises a one-line DyngsError.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dyngs.core.errors import DyngsError, describe_error, format_one_line, wrap_read_errors
from dyngs.io.fields import read_limited

MAX_BYTES = 2**18
"""Largest size of a preset or an override, bytes; packaged presets have less than 5 KB."""
MAX_BRACKETS = 500
"""Most brackets in a file: the YAML scanner takes seconds for thousands."""
_SHOWN = 100
"""Characters of an override quoted in a message."""
_NULL = ("", "~", "null", "Null", "NULL")


@dataclass(frozen=True)
class Leaf:
    """One value of a file or an override: text, a list, None, or {} for an empty section.

    From Python it may also be a number or a bool.

    ``origin`` is the file and line, for messages.
    """

    keys: tuple[str, ...]
    value: Any
    origin: str


def read_file(path: Path) -> list[Leaf]:
    """Return the values of a file in order; an empty section has the value None."""
    with wrap_read_errors(path, "give a YAML preset in UTF-8"):
        text = read_limited(path, MAX_BYTES).decode("utf-8-sig")
    root = _root(text, str(path))
    if root is None:
        return []
    if not isinstance(root, yaml.MappingNode):
        raise DyngsError(f"{path}: must be a mapping of sections (data:, train:, ...)")
    return list(_leaves(root, (), str(path), lines=True))


def read_override(text: str) -> list[Leaf]:
    """Return the values that ``section.key=value`` sets; several if the value is a mapping."""
    key, equals, written = (part.strip() for part in text.partition("="))
    keys = tuple(key.split("."))
    origin = format_one_line(text, _SHOWN)
    if not equals or not all(re.fullmatch(r"\w+", k) for k in keys):
        shown = format_one_line(repr(text), _SHOWN)
        raise DyngsError(
            f"{shown} is not an override; write section.key=value, for instance train.steps=2000"
        )
    if len(written) > MAX_BYTES:
        raise DyngsError(f"{origin}: value too long ({len(written)} characters)")
    try:
        node = _root(written, origin)
    except DyngsError:
        return [Leaf(keys, written, origin)]  # some paths and names are not valid YAML
    if isinstance(node, yaml.MappingNode) and node.flow_style and node.value:
        return list(_leaves(node, keys, origin))
    is_flow = isinstance(node, yaml.CollectionNode) and node.flow_style
    is_quoted = isinstance(node, yaml.ScalarNode) and node.style is not None
    is_null = node is None or (not is_quoted and node.value in _NULL)
    # a block mapping such as "10:" is taken as text
    value = _value(node) if node is not None and (is_flow or is_quoted) else written
    return [Leaf(keys, None if is_null else value, origin)]


def read_mapping(values: Mapping[str, Any], above: str = "") -> Iterator[Leaf]:
    """Yield the values that keyword arguments set: dotted keys or nested mappings."""
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            yield from read_mapping(value, f"{name}.")
        else:
            value = os.fspath(value) if isinstance(value, os.PathLike) else value
            origin = format_one_line(f"{name}={value!r}", _SHOWN)
            yield Leaf(tuple(name.split(".")), value, origin)


def _root(text: str, origin: str) -> yaml.Node | None:
    """Parse YAML text. Raises DyngsError with the line and the problem."""
    if text.count("[") + text.count("{") > MAX_BRACKETS:
        raise DyngsError(f"{origin}: nested too deeply for a configuration")
    try:
        for event in yaml.parse(text, yaml.BaseLoader):
            if isinstance(event, yaml.AliasEvent):
                line = event.start_mark.line + 1
                raise DyngsError(f"{origin}:{line}: aliases (*name) are not allowed here")
        return yaml.compose(text, yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or describe_error(error)
        if "'\\t'" in problem:
            problem = "tabs are not allowed for indentation; use spaces"
        raise DyngsError(
            f"{origin}{line}: not valid YAML: {format_one_line(problem, 2 * _SHOWN)}"
        ) from error


def _leaves(
    node: yaml.MappingNode, above: tuple[str, ...], origin: str, *, lines: bool = False
) -> Iterator[Leaf]:
    seen: set[str] = set()
    for key_node, value_node in node.value:
        where = f"{origin}:{key_node.start_mark.line + 1}" if lines else origin
        if not isinstance(key_node, yaml.ScalarNode):
            raise DyngsError(f"{where}: keys must be plain words")
        key = key_node.value
        shown = format_one_line(".".join((*above, key)), _SHOWN)
        if "." in key:
            raise DyngsError(f"{where}: {shown!r} must be nested in YAML: {key.split('.')[0]}: ...")
        if key in seen:
            raise DyngsError(f"{where}: duplicate key {shown}; keep one of the two")
        seen.add(key)
        if isinstance(value_node, yaml.MappingNode) and value_node.value:
            yield from _leaves(value_node, (*above, key), origin, lines=lines)
        else:
            yield Leaf((*above, key), _value(value_node), where)


def _value(node: yaml.Node) -> Any:
    """Return the text of a node, or a list or mapping of texts; None for a plain null."""
    if isinstance(node, yaml.ScalarNode):
        return None if node.style is None and node.value in _NULL else node.value
    if isinstance(node, yaml.SequenceNode):
        return [_value(item) for item in node.value]
    return {key.value: _value(value) for key, value in node.value}
