"""Format a configuration as YAML with the value, default and description of every key."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from dyngs.config import Config
from dyngs.config.io import find_preset, load_config, load_resolved, packaged_presets
from dyngs.config.schema import allowed_values, default_text, list_kinds, section_classes
from dyngs.config.yaml_reader import read_file, read_override

WIDTH = 118
_NO_ROOT = "FOLDER"


def format_config(source: Path, overrides: list[str]) -> str:
    """Return the resolved configuration of a preset, a YAML file or a run, as YAML with comments.

    The output is a valid preset. A missing ``data.root`` is written as a comment.

    Raises:
        DyngsError: no such preset or run, or a wrong key or value.
    """
    if source.is_dir():
        return _text(load_resolved(source, overrides), True, str(source))
    leaves = [
        *read_file(find_preset(source)),
        *(leaf for text in overrides for leaf in read_override(text)),
    ]
    has_root = any(leaf.keys == ("data", "root") for leaf in leaves)
    config = load_config(source, overrides if has_root else [f"data.root={_NO_ROOT}", *overrides])
    return _text(config, has_root, str(source))


def preset_summaries() -> dict[str, str]:
    """Return the first line, a comment, of each packaged preset by name."""
    files = packaged_presets().items()
    return {name: file.read_text("utf-8").partition("\n")[0].lstrip("# ") for name, file in files}


def _text(config: Config, has_root: bool, source: str) -> str:
    head = f"# {source!r} with every key; train with it: dyngs train THIS_FILE.yaml FOLDER"
    lines = [
        head.encode("unicode_escape").decode("ascii"),
        *_section(config, config.model_dump(mode="json"), 0),
    ]
    text = "\n".join(lines) + "\n"
    return text if has_root else re.sub(r"\n  root: .*", f"\n  # root: {_NO_ROOT}", text, count=1)


def _section(section: BaseModel, values: dict[str, Any], depth: int) -> Iterator[str]:
    space = "  " * depth
    for name, info in type(section).model_fields.items():
        is_section = bool(section_classes(info))
        about = info.description or ""
        if is_section:
            yield "" if depth == 0 else f"{space}#"
            about = (
                f"{about}; kind is one of {', '.join(list_kinds(info))}" if list_kinds(info) else ""
            )
        elif name != "kind":
            about += f" ({allowed_values(info)})"
        yield from (f"{space}# {line}" for line in textwrap.wrap(about, WIDTH - 2 - len(space)))
        if is_section:
            yield f"{space}{name}:"
            yield from _section(getattr(section, name), values[name], depth + 1)
            continue
        dumped = yaml.safe_dump(
            values[name], default_flow_style=True, width=10**6, allow_unicode=False
        )
        shown = dumped.removesuffix("...\n").strip()
        default = default_text(info)
        yield f"{space}{name}: {shown}  # {f'default {default}' if default else 'required'}"
