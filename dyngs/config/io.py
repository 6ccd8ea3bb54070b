"""Configurations from and to YAML: presets, ``a.b=c`` overrides, and errors that say what is
allowed.

A preset is a short YAML file; overrides are laid over it; ``dyngs.config.Config`` checks the result
and fills in the rest. What was resolved is saved with every run and is all that later commands
read.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from dyngs.config import Config
from dyngs.config.schema import (
    allowed_values,
    choices_of,
    config_keys,
    keys_of_location,
    kinds_of,
    section_at,
    section_class,
    section_classes,
)
from dyngs.config.yaml_reader import Leaf, read_file, read_override, require_usable
from dyngs.core.errors import DyngsError, as_word, printable
from dyngs.io.containment import follows_links_of_runs
from dyngs.io.write import write_text
from dyngs.io.wrong_place import command_for

RESOLVED_NAME = "config.yaml"
"""Name of the resolved configuration inside a run folder."""

MAX_WHOLE = 2**63 - 1
"""The largest whole number of a configuration."""
REMOVED_KEYS: dict[tuple[str, ...], object] = {
    ("model", "loose"): False,
    ("budget", "min_fps"): None,
    ("optim", "sparse"): False,
    ("model", "deform", "time_resolution"): 0,
}
"""Keys of earlier versions that configurations of runs may still have, with the value at which they
had no effect."""
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
    "gps": {"widths": [24, 40, 64], "depth_fraction": 0.4},
    "keypoint_nerf": {"features": 32, "width": 64, "patch": 32, "step": 0.015},
    "eg_human_nerf": {
        "features": 32,
        "width": 64,
        "patch": 32,
        "samples": 16,
        "srdf_weight": 0.2,
        "boundaries": True,
        "visibility": True,
    },
}
"""The same for keys of the section ``model`` of one kind."""
MOST_KEYS = 40  # Of a section that are listed in one line
_FOLLOW_LINKS = ("data", "follow_links")
_ODD_LINE_BREAKS = frozenset("\x85\u2028\u2029")


def load_config(preset: Path | str | None, overrides: Iterable[str] = ()) -> Config:
    """Return the configuration of a preset with overrides laid over it.

    Example::

        import dyngs

        config = dyngs.load_config("static", ["data.root=lego", "train.steps=3000"])

    Args:
        preset: a YAML file, or the name of a packaged preset (``static``, ``configs/static.yaml``)
            where no such file exists; None starts from the defaults.
        overrides: ``section.key=value`` with the value in YAML. A changed ``kind`` replaces its
            whole section and nothing outside it, whatever the order of the overrides.

    Returns:
        the checked configuration; ``data.root`` and ``data.body`` are made absolute, so that later
        commands work from any folder. ``model_fields_set`` of its sections has the keys of
        overrides, and those of a file that differ from the packaged presets of its model.

    Raises:
        DyngsError: naming the file and line or the override, the key, and what is allowed.
    """
    layers = _Layers()
    own: set[tuple[str, ...]] = set()
    if preset is not None:
        file = find_preset(Path(preset))
        layers.add(read_file(file))
        if file.resolve() not in [packaged.resolve() for packaged in packaged_presets().values()]:
            own |= _own_keys(layers)
    given = layers.add_overrides(overrides)
    if layers.value_at(_FOLLOW_LINKS) and _FOLLOW_LINKS not in given:
        where = layers.origin_of(_FOLLOW_LINKS)
        raise DyngsError(
            f"{where}: only the command line may set data.follow_links; remove it here and, if you "
            "trust the capture, give data.follow_links=true there"
        )
    own |= given
    config = _validate(layers)
    _note_requested(config, (), own)
    body = config.data.body
    paths = {"root": config.data.root.absolute(), "body": None if body is None else body.absolute()}
    data = config.data.model_copy(update=paths)
    return config.model_copy(update={"data": data})


def load_resolved(
    path: Path, overrides: Iterable[str] = (), data_root: Path | None = None
) -> Config:
    """Return the configuration of a finished or interrupted run.

    Args:
        path: a run folder, or the YAML file in it; a relative ``data.body`` there is one next to
            the file. ``data.follow_links`` has no effect there, see ``following_links_of_runs``.
        overrides: as in ``load_config``.
        data_root: where the capture lies by now, if it was moved.
    """
    file = path / RESOLVED_NAME if path.is_dir() else path
    if not file.is_file():
        raise DyngsError(
            f"{path}: not a run folder (no {RESOLVED_NAME} there); {_instead(path)}give the folder that `dyngs train` "
            "wrote"
        )
    if file == path and command_for(path):
        raise DyngsError(f"{path}: not a run folder; {command_for(path)}")
    layers = _Layers()
    leaves = read_file(file)
    layers.add(x for x in leaves if x.keys not in REMOVED_KEYS or x.value != REMOVED_KEYS[x.keys])
    if not layers.tree.get("data"):
        raise DyngsError(
            f"{file}: does not say which capture the run was trained on (data.root); restore the file"
        )
    if isinstance(layers.tree.get("model"), dict):
        layers.tree["model"] = without_removed_keys(layers.tree["model"])
    if isinstance(layers.tree["data"], dict):
        layers.tree["data"]["follow_links"] = follows_links_of_runs()
    body = layers.value_at(("data", "body"))
    if isinstance(body, str):
        layers.tree["data"]["body"] = str(file.parent.absolute() / body)
    stored_root = layers.value_at(("data", "root"))
    layers.add_overrides(overrides)
    config = _validate(layers)
    root = data_root or config.data.root
    if data_root is None and root == Path(str(stored_root)):
        return config
    return config.model_copy(
        update={"data": config.data.model_copy(update={"root": root.absolute()})}
    )


def without_removed_keys(model: dict[str, object]) -> dict[str, object]:
    """Return the section ``model`` of an earlier version without the keys of
    ``REMOVED_MODEL_KEYS``."""
    removed = REMOVED_MODEL_KEYS.get(str(model.get("kind")), {})
    return {key: x for key, x in model.items() if key not in removed or x != removed[key]}


def save_config(config: Config, path: Path) -> None:
    """Write every value of ``config`` as YAML, atomically: ``path`` is either the old file or the
    new one.

    A ``data.body`` next to the file is written relative to it, so that their folder may be moved.
    """
    values = config.model_dump(mode="json")
    body = config.data.body
    beside = path.parent.absolute()
    if body is not None and body.is_relative_to(beside):
        values["data"]["body"] = body.relative_to(beside).as_posix()
    text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
    if not _ODD_LINE_BREAKS.isdisjoint(text):
        # escapes, where YAML would fold them
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=False)
    write_text(path, text, durable=True)


def find_preset(path: Path) -> Path:
    """Return the preset file meant by ``path``: itself if it exists, else the packaged preset of
    that name.

    Only a bare name or one below ``configs/`` is looked for in the package, so that a mistyped path
    of the user's own is an error. In a source checkout the package's presets are those in the
    repository's ``configs``.
    """
    if path.is_file() and command_for(path) is None:
        return path
    packaged = packaged_presets()
    if (
        path.parent.name in ("", "configs")
        and path.suffix in ("", ".yaml", ".yml")
        and path.stem in packaged
    ):
        return packaged[path.stem]
    found = command_for(path)
    if found is not None:
        raise DyngsError(f"{path}: no configuration; {found}")
    if path.exists() and not path.is_dir():
        raise DyngsError(f"{path}: not a regular file; give a YAML preset")
    close = _close_presets(path.stem, packaged)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise DyngsError(
        f"{path}: no such preset{hint}; the packaged ones are {', '.join(sorted(packaged))}"
    )


def _close_presets(name: str, packaged: Iterable[str]) -> list[str]:
    """Return the packaged preset that is meant by another name, if one is."""
    usual = {"3dgs": "static", "gaussian": "static", "splat": "static", "photos": "static"}
    usual |= {"4dgs": "dynamic", "video": "dynamic", "avatar": "human", "body": "human"}
    names = sorted(packaged)
    within = [preset for preset in names if len(name) > 2 and name.lower() in preset]
    return (
        [usual[name.lower()]]
        if name.lower() in usual
        else get_close_matches(name, names, n=1) or within[:1]
    )


def _instead(path: Path) -> str:
    """Return what ``path`` is if it is no run, and the command for it, to be followed by more; may
    be empty."""
    if path.stem in packaged_presets() and not path.is_dir():
        return f"it is a configuration, for `dyngs train {as_word(path)} data.root=FOLDER`; "
    found = command_for(path)
    return f"{found}; then " if found else ""


def packaged_preset(name: str) -> Path:
    """Return the file of the preset ``name`` that comes with dyngs. Raises DyngsError where there
    is none."""
    packaged = packaged_presets()
    if name not in packaged:
        raise DyngsError(f"no packaged preset {name!r}; there are {', '.join(sorted(packaged))}")
    return packaged[name]


def packaged_presets() -> dict[str, Path]:
    package = Path(__file__).resolve().parents[1]
    folder = next(
        (f for f in (package / "configs", package.parent / "configs") if f.is_dir()), None
    )
    return {f.stem: f for f in sorted(folder.glob("*.yaml"))} if folder else {}


@dataclass
class _Layers:
    """Nested values of a preset and overrides, and for each value where it was written."""

    tree: dict[str, Any] = field(default_factory=dict)
    origins: dict[tuple[str, ...], str] = field(default_factory=dict)
    written: dict[tuple[str, ...], str] = field(default_factory=dict)

    def add(self, leaves: Iterable[Leaf]) -> None:
        for leaf in leaves:
            self._set(leaf)

    def add_overrides(self, overrides: Iterable[str]) -> set[tuple[str, ...]]:
        """Lay overrides over what is there, and return the keys that they set."""
        leaves = [leaf for text in overrides for leaf in read_override(text)]
        # what empties a section goes first, outer sections before inner ones
        for leaf in sorted(
            leaves, key=lambda o: (o.keys[-1] != "kind" and o.value != {}, len(o.keys))
        ):
            if leaf.keys[-1] == "kind":
                self._drop_other_kind(leaf.keys[:-1], leaf.value)
            self._set(leaf)
        return {leaf.keys for leaf in leaves}

    def _drop_other_kind(self, keys: tuple[str, ...], kind: Any) -> None:
        """Empty the section at ``keys`` if it is of another kind than ``kind``."""
        section = self.value_at(keys)
        info = section_at(self.tree, keys).model_fields.get(keys[-1]) if keys else None
        if not isinstance(section, dict) or info is None or not kinds_of(info):
            return
        if section.get("kind", info.get_default().kind) != kind:
            section.clear()
            self.origins = {k: v for k, v in self.origins.items() if k[: len(keys)] != keys}

    def _set(self, leaf: Leaf) -> None:
        require_usable(leaf)
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
        if isinstance(value, str) and value.startswith("~/"):
            value = os.path.expanduser(value)
        section[keys[-1]] = value
        self.origins[keys] = leaf.origin
        self.written[keys] = leaf.text

    def value_at(self, keys: tuple[str, ...]) -> Any:
        """The value or section at ``keys``; None where there is none."""
        node: Any = self.tree
        for key in keys:
            node = node.get(key) if isinstance(node, dict) else None
        return node

    def origin_of(self, keys: tuple[str, ...]) -> str:
        """Where the value at ``keys``, or else the first one below it, was written; "" if
        nowhere."""
        below = (origin for k, origin in self.origins.items() if k[: len(keys)] == keys)
        return self.origins.get(keys) or next(below, "")


def _own_keys(layers: _Layers) -> set[tuple[str, ...]]:
    """Return the keys of a preset file to which no packaged preset of the same ``model.kind`` gives
    the same value.

    A copy of a packaged preset is that preset: its user has requested nothing.
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


def _fill_in_kinds(section: type[BaseModel], node: dict[str, Any]) -> None:
    """Put an empty section where one is absent, and the default ``kind`` where a section with
    variants has none."""
    for name, info in section.model_fields.items():
        if section_classes(info):
            inner = node[name] = {} if node.get(name) is None else node[name]
            if isinstance(inner, dict):
                if kinds_of(info):
                    inner.setdefault("kind", info.get_default().kind)
                _fill_in_kinds(section_class(info, inner.get("kind")), inner)


def _validate(layers: _Layers) -> Config:
    _fill_in_kinds(Config, layers.tree)
    try:
        config = Config.model_validate(layers.tree)
        _require_countable(config.model_dump(), (), layers)
        return config
    except ValidationError as error:
        problems = sorted(
            error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden"
        )
    if _take_as_text(layers, problems):
        return _validate(layers)
    others = len({keys_of_location(problem["loc"]) for problem in problems}) - 1
    more = f" (and {others} more)" if others else ""
    raise DyngsError(_explain(layers, problems[0]) + more)


def _note_requested(
    section: BaseModel, above: tuple[str, ...], requested: set[tuple[str, ...]]
) -> None:
    """Leave only what was ``requested`` in ``model_fields_set`` of a section and those in it."""
    for name in type(section).model_fields:
        inner = getattr(section, name)
        if isinstance(inner, BaseModel):
            _note_requested(inner, (*above, name), requested)
        elif (*above, name) not in requested:
            section.model_fields_set.discard(name)


def _require_countable(section: dict[str, Any], above: tuple[str, ...], layers: _Layers) -> None:
    """Raise DyngsError if a whole number needs more than 64 bits."""
    for key, value in section.items():
        keys = (*above, key)
        if isinstance(value, dict):
            _require_countable(value, keys, layers)
        elif any(
            isinstance(x, int) and abs(x) > MAX_WHOLE
            for x in (value if isinstance(value, tuple) else (value,))
        ):
            raise DyngsError(
                f"{layers.origin_of(keys)}: {'.'.join(keys)} must be below 2^63, not {_shorten(value)}"
            )


def _take_as_text(layers: _Layers, problems: list[ErrorDetails]) -> bool:
    """Replace numbers, dates and such by what was written where the schema wants text; True if
    anything changed."""
    changed = False
    for problem in problems:
        keys = keys_of_location(problem["loc"])
        if problem["type"] in ("string_type", "path_type") and layers.written.get(keys):
            section = layers.value_at(keys[:-1])
            changed = changed or section[keys[-1]] != layers.written[keys]
            section[keys[-1]] = layers.written[keys]
    return changed


def _explain(layers: _Layers, problem: ErrorDetails) -> str:
    keys = keys_of_location(problem["loc"])
    section = section_at(layers.tree, keys)
    what = problem["type"]
    dotted = ".".join(keys)
    origin = layers.origin_of((*keys, "kind") if what == "union_tag_invalid" else keys)
    prefix = f"{origin}: " if origin else ""
    if what == "extra_forbidden":
        return prefix + _explain_unknown(layers, keys)
    info = section.model_fields[keys[-1]]
    if what == "missing":
        example = "data.root=FOLDER" if dotted == "data.root" else f"{dotted}=..."
        return f"{prefix}{dotted} is missing ({info.description}); give {example}"
    if what in ("model_type", "model_attributes_type", "dict_type"):
        inside = dict.fromkeys(
            key for variant in section_classes(info) for key in variant.model_fields
        )
        shown = [*inside][:MOST_KEYS]
        rest = ", ... (docs/cli.md has all)" if len(inside) > len(shown) else ""
        return f"{prefix}{dotted} is a section, not a value; its keys: {', '.join(shown)}{rest}"
    if what == "union_tag_invalid":
        dotted = f"{dotted}.kind"
        value = layers.value_at((*keys, "kind"))
        choices = kinds_of(info)
        allowed = f"one of {', '.join(choices)}"
    else:
        value = layers.value_at(keys)
        choices = choices_of(info.annotation)
        allowed = allowed_values(info)
    close = get_close_matches(value[:100], choices, n=1) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"{prefix}{dotted} must be {allowed}, not {_shorten(value)}{hint}"


def _explain_unknown(layers: _Layers, keys: tuple[str, ...]) -> str:
    """Return a message for a key that its section does not have: which kind has it, or which keys
    are similar."""
    above = keys[:-1]
    dotted = ".".join(keys)
    holder = section_at(layers.tree, above).model_fields.get(above[-1]) if above else None
    variants = section_classes(holder) if holder is not None else []
    owners = [str(v.model_fields["kind"].default) for v in variants if keys[-1] in v.model_fields]
    if owners:
        present = layers.value_at((*above, "kind"))
        return f"{dotted} belongs to {'.'.join(above)}.kind={' or '.join(owners)}, not to {present}"
    full = next((k for k in layers.origins if k[: len(keys)] == keys), keys)
    section = section_at(layers.tree, keys)
    return f"unknown key {_shorten(dotted)}{_did_you_mean_key(full, section, inside=bool(above) and full == keys)}"


def _shorten(value: object) -> str:
    try:
        return printable(repr(value), 60)
    except (ValueError, RecursionError):  # a number of more digits than Python writes
        return "something very long"


def _did_you_mean_key(keys: tuple[str, ...], section: type[BaseModel], inside: bool) -> str:
    """``; did you mean ...?`` with the nearest key: of ``section`` if ``inside``, else the same
    last word elsewhere."""
    everything = list(dict.fromkeys(key.name for key in config_keys()))
    dotted = ".".join(keys)
    siblings = get_close_matches(keys[-1], list(section.model_fields), n=1)
    if siblings and inside:
        return f"; did you mean {'.'.join((*keys[:-1], siblings[0]))!r}?"
    elsewhere = [name for name in everything if name.split(".")[-1] == keys[-1]]
    if len(keys) > 1:
        elsewhere = get_close_matches(dotted, elsewhere, n=1) or elsewhere
    if elsewhere:
        return f"; did you mean {' or '.join(repr(name) for name in elsewhere)}?"
    close = get_close_matches(dotted, everything, n=1)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known here: {', '.join(section.model_fields)}"
