"""Describe the configuration keys (allowed values, default, meaning) and look up sections by kind.

Error messages and docs/reference/config.md are generated from this, so that neither can disagree
with ``dyngs.config``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from dyngs.config import Config
from dyngs.config.kinds import is_kind, kind_names, section_of_kind
from dyngs.core.section import ModelSection


@dataclass(frozen=True)
class ConfigKey:
    """Description of one configuration key.

    Attributes:
        name: dotted, for instance ``train.steps``.
        kinds: kinds that have the key, outermost first, such as ``("dynamic", "mlp")``; empty if
            all kinds have it.
        allowed: allowed values in words.
        default: as YAML; "" if the key is required.
        description: one line.
    """

    name: str
    kinds: tuple[str, ...]
    allowed: str
    default: str
    description: str


def config_keys() -> list[ConfigKey]:
    """Return every key of ``Config`` in declaration order.

    For a section with several kinds: first its ``kind``, then the keys that all kinds share, then
    those of each kind.
    """
    return list(_keys_below(Config, ""))


def _keys_below(section: type[BaseModel], prefix: str) -> Iterator[ConfigKey]:
    """Yield the keys of ``section`` with ``prefix`` before their names."""
    for key, info in section.model_fields.items():
        name = prefix + key
        variants = section_classes(info)
        if not variants:
            yield ConfigKey(
                name, (), allowed_values(info), default_text(info), info.description or ""
            )
        elif len(variants) == 1:
            yield from _keys_below(variants[0], f"{name}.")
        else:
            yield _kind_key(name, info, variants)
            tables = [
                [k for k in _keys_below(v, f"{name}.") if k.name != f"{name}.kind"]
                for v in variants
            ]
            shared = [k for k in tables[0] if all(k in table for table in tables)]
            yield from shared
            kinds = [str(variant.model_fields["kind"].default) for variant in variants]
            for key in dict.fromkeys(k for table in tables for k in table if k not in shared):
                owners = " or ".join(
                    kind for kind, table in zip(kinds, tables, strict=True) if key in table
                )
                yield replace(key, kinds=(owners, *key.kinds))


def _kind_key(name: str, info: FieldInfo, variants: list[type[BaseModel]]) -> ConfigKey:
    """Return the key ``kind`` of the section ``name``, with the descriptions of all kinds."""
    kinds = [variant.model_fields["kind"] for variant in variants]
    meanings = "; ".join(
        f"{', '.join(list_choices(kind.annotation))}: {kind.description}" for kind in kinds
    )
    description = f"{info.description}. {meanings}"
    return ConfigKey(
        f"{name}.kind",
        (),
        f"one of {', '.join(list_kinds(info))}",
        str(default_kind(info)),
        description,
    )


def allowed_values(info: FieldInfo, plural: bool = False) -> str:
    """Return the allowed values of a field in words: ``an integer >= 1``, ``one of white,
    black``."""
    annotation = info.annotation
    optional = NoneType in get_args(annotation)
    plain: Any = (
        next((a for a in get_args(annotation) if a is not NoneType), annotation)
        if optional
        else annotation
    )
    if get_origin(plain) is Annotated:  # an optional type with bounds of its own
        return allowed_values(FieldInfo.from_annotation(plain), plural) + " or null"
    one = {bool: "true or false", int: "an integer", float: "a number", str: "text", Path: "a path"}
    many = {bool: "true or false", int: "integers", float: "numbers", str: "texts", Path: "paths"}
    choices = list_choices(plain)
    if choices:
        text = choices[0] if len(choices) == 1 else f"one of {', '.join(choices)}"
    elif len(get_args(plain)) > 1 and get_origin(plain) in (Union, UnionType):
        text = " or ".join(
            allowed_values(FieldInfo.from_annotation(option)) for option in get_args(plain)
        )
    elif get_origin(plain) is tuple:
        some = any(getattr(item, "min_length", None) for item in info.metadata)
        items = allowed_values(FieldInfo.from_annotation(get_args(plain)[0]), plural=True)
        text = f"a {'non-empty ' if some else ''}list of {items}"
    else:
        text = (many if plural else one).get(plain, str(plain))
    symbols = {"multiple_of": "a multiple of", "gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    bounds = [
        f"{symbol} {getattr(item, name):g}"
        for item in info.metadata
        for name, symbol in symbols.items()
        if getattr(item, name, None) is not None
    ]
    return text + (" " + " and ".join(bounds) if bounds else "") + (" or null" if optional else "")


def list_choices(annotation: Any) -> list[str]:
    """Return the values of a ``Literal`` or an enum as text; none for other types."""
    if get_origin(annotation) is Literal:
        return [str(a) for a in get_args(annotation)]
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(member.value) for member in annotation]
    return []


def default_text(info: FieldInfo) -> str:
    return "" if info.default is PydanticUndefined else format_yaml_value(info.default)


def format_yaml_value(value: object) -> str:
    """Format a value as YAML text."""
    match value:
        case Enum():
            return str(value.value)
        case bool():
            return str(value).lower()
        case None:
            return "null"
        case list() | tuple():
            return f"[{', '.join(format_yaml_value(item) for item in value)}]"
        case float():
            return f"{value:g}"
        case _:
            return str(value)


def is_section(info: FieldInfo) -> bool:
    return _is_any_kind(info) or bool(section_classes(info))


def has_kinds(info: FieldInfo) -> bool:
    """Return whether a section has several kinds."""
    return _is_any_kind(info) or len(section_classes(info)) > 1


def _is_any_kind(info: FieldInfo) -> bool:
    return info.annotation is ModelSection


def section_classes(info: FieldInfo) -> list[type[BaseModel]]:
    """Return the section classes of a field: several for a section with kinds, none for a value."""
    if _is_any_kind(info):
        return [section_of_kind(name) for name in kind_names()]
    options = get_args(info.annotation) or (info.annotation,)
    return [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]


def list_kinds(info: FieldInfo) -> list[str]:
    """Return the kinds of a section; empty if there is only one class."""
    if _is_any_kind(info):
        return kind_names()
    variants = section_classes(info) if has_kinds(info) else []
    return [kind for v in variants for kind in list_choices(v.model_fields["kind"].annotation)]


def allows_kind(info: FieldInfo, kind: object) -> bool:
    """Return whether ``kind`` is a kind of this section."""
    return is_kind(kind) if _is_any_kind(info) else kind in list_kinds(info)


def default_kind(info: FieldInfo) -> str | None:
    """Return the default kind of a section; None if it has only one class."""
    default = info.get_default(call_default_factory=True)
    return getattr(default, "kind", None)


def section_class(info: FieldInfo, kind: object) -> type[BaseModel]:
    """Return the section class of ``kind``, or of the default kind if ``kind`` is unknown."""
    kind = kind if allows_kind(info, kind) else default_kind(info)
    if _is_any_kind(info):
        return section_of_kind(str(kind))
    variants = section_classes(info)
    if len(variants) == 1:
        return variants[0]
    return next(v for v in variants if kind in list_choices(v.model_fields["kind"].annotation))
