"""Load and save configurations: YAML presets, ``section.key=value`` overrides, validation errors.

Overrides are applied on top of a preset; ``dyngs.config.Config`` validates the result and fills in
defaults. Every run stores its resolved configuration, which later commands read.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dyngs.config import Config
from dyngs.config.kinds import is_kind, package_of
from dyngs.config.other_programs import key_of_option
from dyngs.config.schema import (
    allowed_values,
    allows_kind,
    default_kind,
    format_yaml_value,
    has_kinds,
    is_section,
    list_choices,
    list_kinds,
    section_class,
    section_classes,
)
from dyngs.config.yaml_reader import Leaf, read_file, read_mapping, read_override
from dyngs.core.errors import DyngsError, format_one_line, validate_file_name, wrap_read_errors
from dyngs.io.containment import run_links_allowed
from dyngs.io.outputs import suggest_command
from dyngs.io.write import write_text

RESOLVED_NAME = "config.yaml"
"""Name of the resolved configuration inside a run folder."""

REMOVED_KEYS: dict[str, object] = {
    "budget.min_fps": None,
    "colour.lr": 0.01,
    "data.frame_cache_mb": 4096,
    "data.max_megapixels": 150,
    "data.undistort": "same_focal",
    "model.cells": None,
    "model.features": None,
    "model.finest": None,
    "model.levels": None,
    "model.log2_rows": None,
    "model.log2_samples": None,
    "model.loose": False,
    "model.lr_colour": 0.01,
    "model.lr_position": 4e-3,
    "model.lr_position_final": 2e-4,
    "model.near": 0.05,
    "model.num_first": 2000,
    "model.texture_from": 0.7,
    "model.weight_decay": 1e-6,
    "strategy.min_opacity": 0.005,
    "strategy.opacity_reg": 0.01,
    "strategy.scale_reg": 0.01,
    "optim.sparse": False,
    "model.deform.time_resolution": 0,
    "train.tensorboard": False,
}
"""Removed keys that stored configurations may still contain. Maps each key to the value at which it
had no effect; only that value is accepted."""
RENAMED_KEYS = {"model.choose": "model.pilot_runs", "init.trains": "init.trainable"}
"""Former to current key names. Stored configurations are converted; presets and overrides with a
former name are refused."""
_WERE_AUTO = (("camera", "refine"), ("train", "exposure"), ("train", "robust"))
"""Sections and keys with the former value "auto", in requested configurations only."""
_REMOVED_FIELD_KEYS = {"density": "neus", "hidden_views": "excluded", "refine": True}
REMOVED_MODEL_KEYS: dict[str, dict[str, object]] = {
    "human": {
        "refine_from": 0.1,
        "fine_limbs": True,
        "offset_weight": 2e-4,
        "scale_weight": 1e-2,
        "rigidity": 1e-2,
        "smoothness": 1e-3,
    },
    "human_predictor": {
        "min_silhouette_fraction": 0.9,
        "source_sets": 6,
        "target_views": 2,
        "widths": [24, 32, 48, 64],
    },
    "nerf": {"width": 128, "coarse": 32, "fine": 32, "rays": 256},  # sizes=cpu
    "gps": {"widths": [24, 40, 64]},
    "keypoint_nerf": {"features": 32, "width": 64, "step": 0.015, "training_views": "any"},
    "eg_human_nerf": {
        "features": 32,
        "width": 64,
        "samples": 16,
        "srdf_weight": 0.2,
        "boundaries": True,
        "visibility": True,
        "training_views": "any",
        **_REMOVED_FIELD_KEYS,
    },
    "predicted_field": _REMOVED_FIELD_KEYS,
}
"""``REMOVED_KEYS`` of the section ``model``, by kind of model."""
_FOLLOW_LINKS = ("data", "follow_links")
_ODD_LINE_BREAKS = frozenset("\x85\u2028\u2029")


Overrides = Iterable[str] | Mapping[str, Any]
"""``section.key=value`` texts, or values by dotted key or in nested mappings."""


def load_config(preset: Path | str | None, overrides: Overrides = ()) -> Config:
    """Return the configuration of a preset with overrides applied.

    Example:

        import dyngs

        config = dyngs.load_config("static", ["data.root=lego", "train.steps=3000"])

    Args:
        preset: a YAML file, or the name of a packaged preset (``static``, ``configs/static.yaml``)
            where no such file exists; None starts from the defaults.
        overrides: ``section.key=value`` with the value in YAML, or a mapping such as
            ``{"train.steps": 3000}`` or ``{"train": {"steps": 3000}}``. A changed ``kind`` resets
            its section to the defaults of that kind, in any order of the overrides.

    Returns:
        the validated configuration, with absolute ``data.root`` and ``data.body``. In each section
        ``model_fields_set`` holds the keys that the user set: overrides, and values of a file that
        differ from the packaged presets.

    Raises:
        DyngsError: an unknown key or invalid value; the message has the file and line or the
            override, the key, and the allowed values.
    """
    layers = _Layers()
    own: set[tuple[str, ...]] = set()
    if preset is not None:
        file = find_preset(Path(preset))
        layers.add(read_file(file))
        if file.resolve() not in [packaged.resolve() for packaged in packaged_presets().values()]:
            own |= _own_keys(layers)
    given = layers.add_overrides(overrides)
    config = _completed(layers, own | given)
    if config.data.follow_links and _FOLLOW_LINKS not in given:
        raise DyngsError(
            f"{layers.origin_of(_FOLLOW_LINKS)}data.follow_links is allowed on the command line "
            "only; remove it here and, if you trust the capture, add data.follow_links=true there"
        )
    return config


def replace_config(config: Config, changes: Mapping[str, Any]) -> Config:
    """Return a config with some values changed, see ``Config.replace``."""
    layers = _Layers()
    layers.add(read_mapping(config.model_dump(mode="json")))
    layers.origins.clear()
    given = layers.add_overrides(changes)
    requested = {leaf.keys for leaf in read_mapping(config.model_dump(exclude_unset=True))}
    return _completed(layers, given | requested)


def _completed(layers: _Layers, requested: set[tuple[str, ...]]) -> Config:
    """Return the validated config with absolute paths; ``requested`` are the keys of the user."""
    config = _validated(layers)
    _note_requested(config, (), requested)
    body = config.data.body
    paths = {"root": config.data.root.absolute(), "body": None if body is None else body.absolute()}
    data = config.data.model_copy(update=paths)
    return config.model_copy(update={"data": data})


def load_resolved(
    path: Path, overrides: Iterable[str] = (), data_root: Path | None = None
) -> Config:
    """Return the configuration of a finished or interrupted run.

    Args:
        path: a run folder, or the YAML file in it; a relative ``data.body`` is relative to the
            file. A stored ``data.follow_links`` is ignored, see ``allow_run_links``.
        overrides: as in ``load_config``.
        data_root: current folder of the capture, if it was moved.
    """
    file = path / RESOLVED_NAME if path.is_dir() else path
    found = suggest_command(path)
    if not file.is_file() or (file == path and found):
        hint = f"{found}; then " if found else ""
        raise DyngsError(
            f"{path}: not a run folder (no {RESOLVED_NAME}); "
            f"{hint}give a folder written by `dyngs train`"
        )
    layers = _Layers()
    layers.add(read_file(file))
    _convert_renamed_keys(layers.tree)
    data = layers.tree.get("data")
    if not data:
        raise DyngsError(f"{file}: data.root, the capture of the run, is missing; restore the file")
    stored_root = None
    if isinstance(data, dict):
        stored_root = data.get("root")
        data["follow_links"] = run_links_allowed()
        # Runs of versions without this key were trained on full images.
        data.setdefault("longest_side", None)
        # and held out the first image.
        data.setdefault("test_first", 0)
        if isinstance(data.get("body"), str):
            data["body"] = str(file.parent.absolute() / data["body"])
    layers.add_overrides(overrides)
    config = _validated(layers)
    root = data_root or config.data.root
    if data_root is None and root == Path(str(stored_root)):
        return config
    data = config.data.model_copy(update={"root": root.absolute()})
    return config.model_copy(update={"data": data})


def _convert_renamed_keys(tree: dict[str, Any]) -> None:
    """Replace former key names and values by the current ones, in place."""
    for former, current in RENAMED_KEYS.items():
        section_name, key = former.split(".")
        section = tree.get(section_name)
        if isinstance(section, dict) and key in section:
            section[current.split(".")[1]] = section.pop(key)
    for section_name, key in _WERE_AUTO:
        section = tree.get(section_name)
        if isinstance(section, dict) and section.get(key) == "auto":
            section[key] = "never"


def drop_removed_model_keys(model: dict[str, object]) -> dict[str, object]:
    """Return a stored section ``model`` without the keys in ``REMOVED_MODEL_KEYS``."""
    removed = REMOVED_MODEL_KEYS.get(str(model.get("kind")), {})
    return {key: x for key, x in model.items() if not _is_removed(key, x, removed)}


def save_config(config: Config, path: Path) -> None:
    """Write all values of ``config`` as YAML, atomically.

    A ``data.body`` inside the folder of ``path`` is stored relative to it, so that the run folder
    may be moved.
    """
    values = config.model_dump(mode="json")
    package = package_of(config.model.kind)
    if package is not None:
        values["model"]["package"] = package
    body = config.data.body
    beside = path.parent.absolute()
    if body is not None and body.is_relative_to(beside):
        values["data"]["body"] = body.relative_to(beside).as_posix()
    text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
    if not _ODD_LINE_BREAKS.isdisjoint(text):
        # unescaped, YAML would fold these line breaks
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=False)
    write_text(path, text, durable=True)


def find_preset(path: Path) -> Path:
    """Return ``path`` if the file exists, else the packaged preset of that name.

    Only a bare name or one below ``configs/`` matches a packaged preset, so that other mistyped
    paths are errors. A source checkout uses the presets in the repository's ``configs``.
    """
    found = suggest_command(path)
    if path.is_file() and found is None:
        return path
    packaged = packaged_presets()
    is_bare = path.parent.name in ("", "configs") and path.suffix in ("", ".yaml", ".yml")
    if is_bare and path.stem in packaged:
        return packaged[path.stem]
    if found is not None:
        raise DyngsError(f"{path}: not a configuration; {found}")
    close = get_close_matches(path.stem, packaged, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise DyngsError(
        f"{path}: no such preset{hint}; packaged presets: {', '.join(sorted(packaged))}"
    )


def packaged_preset(name: str) -> Path:
    """Return the file of the packaged preset ``name``. Raises DyngsError: unknown name."""
    packaged = packaged_presets()
    if name not in packaged:
        raise DyngsError(f"no packaged preset {name!r}; available: {', '.join(sorted(packaged))}")
    return packaged[name]


def packaged_presets() -> dict[str, Path]:
    package = Path(__file__).resolve().parents[1]
    # inside the package, or in a source tree next to it
    folders = [package / "configs", package.parent / "configs"]
    return {f.stem: f for folder in folders for f in sorted(folder.glob("*.yaml"))}


@dataclass
class _Layers:
    """Nested values of a preset and overrides as text, and the origin (file and line) of each."""

    tree: dict[str, Any] = field(default_factory=dict)
    origins: dict[tuple[str, ...], str] = field(default_factory=dict)

    def add(self, leaves: Iterable[Leaf]) -> None:
        for leaf in leaves:
            self._set(leaf)

    def add_overrides(self, overrides: Overrides) -> set[tuple[str, ...]]:
        """Apply overrides, and return the keys that they set."""
        if isinstance(overrides, Mapping):
            leaves = list(read_mapping(overrides))
        else:
            leaves = [leaf for text in overrides for leaf in read_override(text)]
        # a ``kind`` or {} clears its section, so these come first, outer sections before inner ones
        for leaf in sorted(
            leaves, key=lambda o: (o.keys[-1] != "kind" and o.value != {}, len(o.keys))
        ):
            if leaf.keys[-1] == "kind":
                self._drop_other_kind(leaf.keys[:-1], leaf.value)
            self._set(leaf)
        return {leaf.keys for leaf in leaves}

    def _drop_other_kind(self, keys: tuple[str, ...], kind: Any) -> None:
        """Clear the section at ``keys`` if its kind is not ``kind``."""
        section = self.value_at(keys)
        info = self.field_at(keys)
        if not isinstance(section, dict) or info is None or not has_kinds(info):
            return
        if section.get("kind", default_kind(info)) != kind:
            section.clear()
            self.origins = {k: v for k, v in self.origins.items() if k[: len(keys)] != keys}

    def section_at(self, keys: tuple[str, ...], info: FieldInfo) -> type[BaseModel] | None:
        """Return the section class of the selected kind at ``keys``; None if it is a value."""
        if not is_section(info):
            return None
        node = self.value_at(keys)
        return section_class(info, node.get("kind") if isinstance(node, dict) else None)

    def field_at(self, keys: tuple[str, ...]) -> FieldInfo | None:
        """Return the field at ``keys`` in the sections of the selected kinds; None if unknown."""
        section: type[BaseModel] | None = Config
        info: FieldInfo | None = None
        for depth, key in enumerate(keys, 1):
            info = section.model_fields.get(key) if section else None
            section = self.section_at(keys[:depth], info) if info else None
        return info

    def names(self, section: type[BaseModel], above: tuple[str, ...]) -> Iterator[str]:
        """Yield the dotted names of all keys in the sections of the selected kinds."""
        for key, info in section.model_fields.items():
            inner = self.section_at((*above, key), info)
            if inner is None:
                yield ".".join((*above, key))
            else:
                yield from self.names(inner, (*above, key))

    def _set(self, leaf: Leaf) -> None:
        keys = leaf.keys
        value = leaf.value
        section = self.tree
        for depth, key in enumerate(keys[:-1], start=1):
            inner = section.setdefault(key, {})
            if inner is None:
                inner = section[key] = {}
            if not isinstance(inner, dict):
                raise DyngsError(
                    f"{leaf.origin}: {'.'.join(keys[:depth])} is a value, it has no key {keys[depth]!r}"
                )
            section = inner
        if isinstance(value, str):
            with wrap_read_errors(f"{leaf.origin}: {format_one_line('.'.join(keys), 100)}"):
                validate_file_name(value)
            value = os.path.expanduser(value) if value.startswith("~/") else value
        section[keys[-1]] = value
        self.origins[keys] = leaf.origin

    def value_at(self, keys: tuple[str, ...]) -> Any:
        """Return the value or section at ``keys``; None if missing."""
        node: Any = self.tree
        for key in keys:
            node = node.get(key) if isinstance(node, dict) else None
        return node

    def origin_of(self, keys: tuple[str, ...]) -> str:
        """Return the origin of the value at ``keys``, or of the first value below it, as a message
        prefix."""
        below = (origin for k, origin in self.origins.items() if k[: len(keys)] == keys)
        origin = self.origins.get(keys) or next(below, "")
        return f"{origin}: " if origin else ""


def _is_removed(key: str, written: object, removed: Mapping[str, object]) -> bool:
    """Return whether ``removed`` lists ``key`` with the value ``written`` in a file."""
    if key not in removed:
        return False
    value = removed[key]
    if format_yaml_value(written) == format_yaml_value(value):
        return True
    try:
        return float(str(written)) == value
    except ValueError:
        return False


def _own_keys(layers: _Layers) -> set[tuple[str, ...]]:
    """Return the keys of a preset file whose values differ from all packaged presets of its
    ``model.kind``.

    Only these count as requested by the user: a copy of a packaged preset requests nothing.
    """
    own = set(layers.origins)
    kind = layers.value_at(("model", "kind"))
    for file in packaged_presets().values():
        packaged = _Layers()
        packaged.add(read_file(file))
        if packaged.value_at(("model", "kind")) == kind:
            own -= {
                keys
                for keys in own & packaged.origins.keys()
                if packaged.value_at(keys) == layers.value_at(keys)
            }
    return own


def _validated(layers: _Layers) -> Config:
    tree = layers.tree
    model = tree.get("model")
    package = model.pop("package", None) if isinstance(model, dict) else None
    if isinstance(model, dict) and package is not None and not is_kind(model.get("kind")):
        raise DyngsError(
            f"model.kind={model.get('kind')} needs the package {package}, which is not installed; "
            f"run `pip install {package}`"
        )
    return cast(Config, _section(Config, tree, (), layers))


def _section(
    section: type[BaseModel], given: dict[str, Any], above: tuple[str, ...], layers: _Layers
) -> BaseModel:
    """Validate the values in ``given`` as a section. Raises DyngsError: the first error."""
    prefix = ".".join(above)
    removed = {name.removeprefix(f"{prefix}."): x for name, x in REMOVED_KEYS.items()}
    if prefix == "model":
        removed |= REMOVED_MODEL_KEYS.get(section.model_fields["kind"].default, {})
    values = {
        key: x
        for key, x in given.items()
        if key in section.model_fields or not _is_removed(key, x, removed)
    }
    for key in values:
        if key not in section.model_fields:
            raise DyngsError(_describe_unknown(section, (*above, key), layers))
    for name, info in section.model_fields.items():
        keys = (*above, name)
        if not is_section(info):
            continue
        inner = {} if given.get(name) is None else given[name]
        if not isinstance(inner, dict):
            where = layers.origin_of(keys)
            raise DyngsError(
                f"{where}{'.'.join(keys)} is a section, not a value; set one of its keys"
            )
        kind = inner.get("kind") or default_kind(info)
        if has_kinds(info) and not allows_kind(info, kind):
            where = layers.origin_of((*keys, "kind"))
            allowed = f"one of {', '.join(list_kinds(info))}"
            raise DyngsError(where + _not_allowed((*keys, "kind"), allowed, kind, list_kinds(info)))
        values[name] = _section(section_class(info, kind), inner, keys, layers)
    try:
        return section.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
    keys = (*above, str(problem["loc"][0]))
    info = section.model_fields[keys[-1]]
    where = layers.origin_of(keys)
    if problem["type"] == "missing" and len(problem["loc"]) == 1:
        name = ".".join(keys)
        example = "data.root=FOLDER" if name == "data.root" else f"{name}=..."
        raise DyngsError(f"{where}{name} is required ({info.description}); add {example}")
    if problem["type"] == "value_error":
        raise DyngsError(f"{where}{'.'.join(keys)} {problem.get('ctx', {}).get('error')}")
    choices = list_choices(info.annotation)
    raise DyngsError(where + _not_allowed(keys, allowed_values(info), values[keys[-1]], choices))


def _not_allowed(keys: tuple[str, ...], allowed: str, value: object, choices: list[str]) -> str:
    close = get_close_matches(value[:100], choices, n=1) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{'.'.join(keys)} must be {allowed}, not {format_one_line(format_yaml_value(value), 60)}{hint}"


def _describe_unknown(section: type[BaseModel], keys: tuple[str, ...], layers: _Layers) -> str:
    """Return the error for an unknown key: its new name, the kind that has it, or a similar key."""
    *above, key = keys
    name = ".".join(keys)
    where = layers.origin_of(keys)
    if name in RENAMED_KEYS:
        return f"{where}{name} was renamed; use {RENAMED_KEYS[name]}"
    holder = layers.field_at(tuple(above))
    variants = [] if holder is None else section_classes(holder)
    owners = [x.model_fields["kind"].default for x in variants if key in x.model_fields]
    if owners:
        kind = section.model_fields["kind"].default
        return (
            f"{where}{name} belongs to {'.'.join(above)}.kind={' or '.join(owners)}, not to {kind}"
        )
    other = key_of_option(key)
    if other is not None:
        return f"{where}unknown key {format_one_line(repr(name), 60)}; use {other}"
    written = ".".join(next((k for k in layers.origins if k[: len(keys)] == keys), keys))
    known = list(layers.names(Config, ()))
    last = written.rpartition(".")[2]
    same = [x for x in known if x.rpartition(".")[2] == last]
    # a shared section makes names similar, so the last word must be similar as well
    close = get_close_matches(written, same or known, n=1)
    found = [x for x in close if get_close_matches(last, [x.rpartition(".")[2]])] or same
    hint = f"; did you mean {' or '.join(map(repr, found))}?" if found else ""
    return f"{where}unknown key {format_one_line(repr(name), 60)}{hint}"


def _note_requested(
    section: BaseModel, above: tuple[str, ...], requested: set[tuple[str, ...]]
) -> None:
    """Keep only ``requested`` keys in ``model_fields_set``, recursively."""
    for name in type(section).model_fields:
        inner = getattr(section, name)
        if isinstance(inner, BaseModel):
            _note_requested(inner, (*above, name), requested)
        elif (*above, name) not in requested:
            section.model_fields_set.discard(name)
