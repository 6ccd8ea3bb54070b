"""The keys of the configuration in words: what each accepts, its default, what it is for.

Error messages and the documentation's table are made from this, so that neither can disagree with ``dyngs.config``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from dyngs.config import Config


@dataclass(frozen=True)
class ConfigKey:
    """One key of the configuration, for people.

    Attributes:
        name: dotted, for instance ``train.steps``.
        kind: the section's variant if it has several (the default ``kind``), else "".
        allowed: what it may be, in words.
        default: as YAML, "" where the key is required.
        description: one line, may be empty.
    """

    name: str
    kind: str
    allowed: str
    default: str
    description: str


def config_keys() -> list[ConfigKey]:
    """Every key of ``Config`` in declaration order; a ``kind`` that decides on the section's other keys comes once."""
    rows = []
    for name, info in Config.model_fields.items():
        models = section_classes(info)
        if len(models) > 1:
            kinds = [kind for model in models for kind in choices_of(model.model_fields["kind"].annotation)]
            rows.append(ConfigKey(f"{name}.kind", "", f"one of {', '.join(kinds)}", info.get_default().kind, ""))
        for model in models:
            variant = str(model.model_fields["kind"].default) if len(models) > 1 else ""
            for key, inner in model.model_fields.items():
                if not (variant and key == "kind"):
                    words = (allowed_values(inner), _default_text(inner), inner.description or "")
                    rows.append(ConfigKey(f"{name}.{key}", variant, *words))
    return rows


def keys_table() -> str:
    """All keys as a table in Markdown, for docs/cli.md."""
    lines = ["| key | allowed | default | |", "|---|---|---|---|"]
    for key in config_keys():
        variant = f" ({key.kind})" if key.kind else ""
        default = f"`{key.default}`" if key.default else "required"
        lines.append(f"| `{key.name}`{variant} | {key.allowed} | {default} | {key.description} |")
    return "\n".join(lines) + "\n"


def allowed_values(info: FieldInfo) -> str:
    """What a field accepts, in words: ``an integer >= 1``, ``one of white, black``, ``true or false``."""
    annotation = info.annotation
    optional = NoneType in get_args(annotation)
    plain = next((a for a in get_args(annotation) if a is not NoneType), annotation) if optional else annotation
    choices = choices_of(plain)
    words = {bool: "true or false", int: "an integer", float: "a number", str: "text", Path: "a path"}
    text = f"one of {', '.join(choices)}" if choices else words.get(plain, str(plain))  # type: ignore[arg-type]
    symbols = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    bounds = [
        f"{symbol} {getattr(item, name):g}"
        for item in info.metadata
        for name, symbol in symbols.items()
        if getattr(item, name, None) is not None
    ]
    return text + (" " + " and ".join(bounds) if bounds else "") + (" or null" if optional else "")


def choices_of(annotation: Any) -> list[str]:
    """The values of a ``Literal`` or an enum as text; none for other types."""
    if get_origin(annotation) is Literal:
        return [str(a) for a in get_args(annotation)]
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(member.value) for member in annotation]
    return []


def _default_text(info: FieldInfo) -> str:
    if info.default is PydanticUndefined:
        return ""
    value = info.default.value if isinstance(info.default, Enum) else info.default
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def section_classes(info: FieldInfo) -> list[type[BaseModel]]:
    """The section classes that a field of ``Config`` may hold."""
    options = get_args(info.annotation) or (info.annotation,)
    return [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]


def section_class(name: str, kind: object = None) -> type[BaseModel]:
    """The class of section ``name`` in its variant ``kind`` (the first one where there is no such variant)."""
    models = section_classes(Config.model_fields[name])
    chosen = (m for m in models if "kind" in m.model_fields and kind in choices_of(m.model_fields["kind"].annotation))
    return next(chosen, models[0])


def keys_of_section(name: str) -> list[str]:
    """The keys of all variants of section ``name``."""
    return list(dict.fromkeys(k.name.split(".")[1] for k in config_keys() if k.name.startswith(f"{name}.")))
