"""Read YAML of presets and overrides as values with their origin (file, line); every YAML error
becomes a DyngsError.

A scalar that looks like a number or a date but is none (``2024-02-30``, ``0x_``, 5,000 digits) is
read as text; the schema then says what it must be.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError
from yaml.reader import ReaderError

from dyngs.core.errors import DyngsError, printable, reason, require_name

MAX_BYTES = 2**18
"""Largest size of a preset or an override: read in 3 s; the longest that we know has 5 KB."""
MAX_DEPTH = 40
"""Deepest nesting of mappings and lists; a configuration has 4."""
_BITS = 63
"""Largest size of an integer."""
_SHOWN = 100
"""Characters of an override that a message repeats."""
_NUMBER_TAGS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_ODD_NUMBER = re.compile(r"[-+_\s]*(0[\d_]|[\d_]+:)")
"""YAML 1.1 takes 010 for 8 and 1:30 for 90: nobody means that."""
_LONGEST_NUMBER = 400
"""Characters; longer numbers take quadratic time."""
_EXACT_FLOAT = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$")


@dataclass(frozen=True)
class Leaf:
    """One value of a file or an override: its keys, its value, its text, and its origin for
    messages."""

    keys: tuple[str, ...]
    value: Any
    text: str
    origin: str


def read_file(path: Path) -> list[Leaf]:
    """Read the values of a file in its order; an empty section is a leaf of value None."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror})") from None
    if len(data) > MAX_BYTES:
        raise DyngsError(
            f"{path}: is larger than {MAX_BYTES // 2**10} KiB, no configuration is; give a YAML preset"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DyngsError(f"{path}: not a text file in UTF-8; give a YAML preset") from None
    return [replace(leaf, value=deepcopy(leaf.value)) for leaf in _leaves(text, str(path))]


@lru_cache(maxsize=16)
def _leaves(text: str, origin: str) -> tuple[Leaf, ...]:
    """Read the values of the text of a file; a command asks several times for those of the same
    run."""
    with _loaded(text, origin) as loader:
        root = loader.get_single_node()
        if root is None:
            return ()
        if not isinstance(root, yaml.MappingNode):
            raise DyngsError(f"{origin}: must be a mapping of sections (data:, train:, ...)")
        return tuple(_walk(loader, root, (), origin, lines=True))


def read_override(text: str) -> list[Leaf]:
    """Read the values that ``section.key=value`` sets: one, or several where it sets a full
    section."""
    key, equals, written = (part.strip() for part in text.partition("="))
    keys = tuple(key.split("."))
    origin = printable(text, _SHOWN)
    if not equals or not all(re.fullmatch(r"\w+", k) for k in keys):
        shown = printable(repr(text), _SHOWN)
        raise DyngsError(
            f"{shown} is not an override; write section.key=value, for instance train.steps=2000"
        )
    if len(written) > MAX_BYTES:
        raise DyngsError(f"{origin}: has {len(written)} characters; no value is as long")
    try:
        with _loaded(written, origin) as loader:
            node = loader.get_single_node()
            if isinstance(node, yaml.MappingNode) and not node.flow_style:
                # "10:", which only looks like a mapping
                return [Leaf(keys, written, written, origin)]
            if isinstance(node, yaml.MappingNode) and node.value:
                return [replace(leaf, origin=origin) for leaf in _walk(loader, node, keys, origin)]
            value = None if node is None else loader.construct_object(node, deep=True)  # type: ignore[no-untyped-call]
    except _NotYaml:
        value = written  # a path or a name that happens not to be YAML
    return [Leaf(keys, value, written, origin)]


class _NotYaml(DyngsError):
    """Text that is not valid YAML, as opposed to YAML that is not allowed here."""


class _PresetLoader(yaml.SafeLoader):
    """Safe YAML without aliases, of limited depth, and with ``1e-4`` read as the number that it
    is."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self.check_event(yaml.AliasEvent):
            raise ComposerError(None, None, "aliases (*name) are not allowed here", mark)
        if self.depth > MAX_DEPTH:
            raise ComposerError(None, None, "nested too deeply for a configuration", mark)
        self.depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self.depth -= 1

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:
        if self.flow_level > MAX_DEPTH:
            # before composing: thousands of brackets take the scanner seconds
            raise ComposerError(
                None, None, "nested too deeply for a configuration", self.get_mark()
            )
        super().fetch_flow_collection_start(TokenClass)  # type: ignore[no-untyped-call]

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node; its text where it only looks like a number or date, or is too
        large a number."""
        if not isinstance(node, yaml.ScalarNode):
            return super().construct_object(node, deep)  # type: ignore[no-untyped-call]
        is_number = node.tag in _NUMBER_TAGS
        if is_number and (_ODD_NUMBER.match(node.value) or len(node.value) > _LONGEST_NUMBER):
            return node.value
        try:
            value = super().construct_object(node, deep)  # type: ignore[no-untyped-call]
        except Exception:  # of int(), date() and the like, which YAML passes on
            return node.value
        return node.value if isinstance(value, int) and value.bit_length() > _BITS else value


_PresetLoader.add_implicit_resolver("tag:yaml.org,2002:float", _EXACT_FLOAT, list("-+.0123456789"))


@contextmanager
def _loaded(text: str, origin: str) -> Iterator[_PresetLoader]:
    """Yield a loader of ``text``; whatever YAML raises in the block is one line."""
    loader: _PresetLoader | None = None
    try:
        loader = _PresetLoader(text)
        yield loader
    except DyngsError:
        raise
    except Exception as error:
        raise _NotYaml(f"{origin}{_problem(error, text)}") from error
    finally:
        if loader is not None:
            loader.dispose()


def _problem(error: Exception, text: str) -> str:
    """Return the line and what is wrong there, after the origin."""
    if isinstance(error, RecursionError):
        return ": nested too deeply for a configuration"
    if isinstance(error, ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return f":{line}: not valid YAML: the control character {chr(error.character)!r}; remove it"
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        problem = printable(error.problem or error.context or "not valid YAML", 2 * _SHOWN)
        if "'\\t'" in problem:
            problem = "a tab where YAML wants spaces; indent with spaces"
        return f"{f':{mark.line + 1}' if mark is not None else ''}: not valid YAML: {problem}"
    return f": not valid YAML: {reason(error)}"


def _walk(
    loader: yaml.SafeLoader,
    node: yaml.MappingNode,
    above: tuple[str, ...],
    origin: str,
    *,
    lines: bool = False,
) -> Iterator[Leaf]:
    seen: set[str] = set()
    for key_node, value_node in node.value:
        where = f"{origin}:{key_node.start_mark.line + 1}" if lines else origin
        if not isinstance(key_node, yaml.ScalarNode):
            raise DyngsError(f"{where}: keys must be plain words")
        key = key_node.value
        shown = printable(key, _SHOWN)
        if "." in key:
            raise DyngsError(
                f"{where}: {shown!r} must be nested in YAML: {shown.replace('.', ': {', 1)}: ...}}"
            )
        if key in seen:
            dotted = printable(".".join((*above, key)), _SHOWN)
            raise DyngsError(f"{where}: duplicate key {dotted}; keep one of the two")
        seen.add(key)
        if isinstance(value_node, yaml.MappingNode) and value_node.value:
            yield from _walk(loader, value_node, (*above, key), origin, lines=lines)
        else:
            text = value_node.value if isinstance(value_node, yaml.ScalarNode) else ""
            yield Leaf((*above, key), loader.construct_object(value_node, deep=True), text, where)


def require_usable(leaf: Leaf) -> None:
    """Raise DyngsError if a text cannot be a file name: NUL, or not a character."""
    if isinstance(leaf.value, str):
        try:
            require_name(leaf.value)
        except DyngsError as error:
            raise DyngsError(
                f"{leaf.origin}: {printable('.'.join(leaf.keys), _SHOWN)}: {error}"
            ) from None
