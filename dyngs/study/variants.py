"""Variants of a run: the settings that can be varied, and what one variant changes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

from pydantic import ConfigDict

from dyngs.config import Config
from dyngs.config.schema import kinds_of
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, printable
from dyngs.deform.keys import DynamicModel

Value = float | int | str
SEVERAL = "several"
"""Stands for the setting of a variant that changes more than one."""
AUTO = "auto"
"""Storage with the default quantisation of ``dyngs export --format dyngs``."""
_DRAWN = ("mode", "alpha_min", "transmittance_min", "supersampling")  # options of a render, by name


@dataclass(frozen=True)
class Variant:
    """Changes of a run; the defaults change nothing.

    Attributes:
        colour, field: ``colour.kind`` and ``model.deform.kind`` to train with.
        field_size: factor on the nodes, channels, neurons or frequencies of the field to train
            with.
        prune: fraction of the Gaussians removed, by ``sensitivity``.
        mask_times: key times of visibility masks.
        finetune: training steps after pruning and masking.
        sh_degree: higher spherical harmonics are dropped.
        storage: allowed change of images by quantisation, grey levels of 255, or "auto"; None:
            float32.
        field_step: factor on the quantisation steps of the field.
        mode, alpha_min, transmittance_min: ``model.rasterize_mode`` and so on to render with.
        supersampling: the same of curved triangles.
        triangles: factor on the number of triangles to train with.
        scale: width and height rendered, relative to those shown.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)
    colour: str | None = None
    field: str | None = None
    field_size: float = 1.0
    prune: float = 0.0
    mask_times: int = 0
    finetune: int = 0
    sh_degree: int | None = None
    storage: float | str | None = None
    field_step: float = 1.0
    mode: str | None = None
    alpha_min: float | None = None
    transmittance_min: float | None = None
    scale: float = 1.0
    supersampling: int | None = None
    triangles: float = 1.0

    @property
    def changes(self) -> dict[str, Value]:
        """The fields that differ from the run; ``Variant(**changes)`` is the variant again."""
        return {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if getattr(self, f.name) != f.default
        }

    @property
    def name(self) -> str:
        words = (
            f"{k}={x:g}" if isinstance(x, float) else f"{k}={x}" for k, x in self.changes.items()
        )
        return " ".join(words) or "as it is"

    @property
    def slug(self) -> str:
        """File name, different for different variants."""
        return (
            "_".join(f"{k}-{x!r}".replace("'", "") for k, x in self.changes.items()) or "as_it_is"
        )

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the changed settings; ``finetune`` and ``field_step`` belong to the ones before
        them."""
        return tuple(name for name in self.changes if name not in ("finetune", "field_step"))

    @property
    def setting(self) -> str:
        """The changed setting with what belongs to it; "" for the run itself, ``SEVERAL`` for
        combinations."""
        return SEVERAL if len(self.settings) > 1 else " + ".join(self.changes)

    @property
    def stored(self) -> Variant:
        """The variant without the changes that only concern rendering."""
        return replace(self, scale=1.0, **dict.fromkeys(_DRAWN))

    @property
    def drawn(self) -> dict[str, Value]:
        """The changed options of a render, by name."""
        return {
            name: RasterizeMode(x) if name == "mode" else x
            for name, x in self.changes.items()
            if name in _DRAWN
        }

    @property
    def trained(self) -> Variant:
        """The variant with only the changes that need training from scratch."""
        return Variant(
            colour=self.colour,
            field=self.field,
            field_size=self.field_size,
            triangles=self.triangles,
        )

    def merged(self, other: Variant) -> Variant:
        """Return this variant with the changes of ``other`` on top."""
        return replace(self, **other.changes)


@dataclass(frozen=True)
class Varied:
    """A setting that can be varied.

    Attributes:
        name: a field of ``Variant``.
        values: tried by default, stronger ones later.
        low, high: range of numbers, inclusive; no numbers if ``low > high``.
        words: allowed next to numbers.
        integers: no other numbers.
        trains: every value but that of the run needs training from scratch.
    """

    name: str
    values: tuple[Value, ...]
    low: float = 1.0
    high: float = 0.0
    words: tuple[str, ...] = ()
    integers: bool = False
    trains: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values, for messages."""
        kind = "a whole number" if self.integers else "a number"
        number = [f"{kind} from {self.low:g} to {self.high:g}"] if self.low <= self.high else []
        return " or ".join([*number, *self.words])

    def parsed(self, text: str) -> Value:
        if text in self.words:
            return text
        try:
            value = int(text) if self.integers else float(text)
        except ValueError:
            value = float("nan")
        if not self.low <= value <= self.high:
            raise DyngsError(f"--vary {self.name}={printable(text, 60)}: give {self.allowed}")
        return value


_FIELDS = tuple(kinds_of(DynamicModel.model_fields["deform"]))
_COLOURS = tuple(kinds_of(Config.model_fields["colour"]))
_MODES = tuple(mode.value for mode in RasterizeMode)
SETTINGS = (
    Varied("prune", (0.3, 0.5, 0.7, 0.85), low=0.01, high=0.99),
    Varied("mask_times", (6, 16), low=2, high=1000, integers=True),
    Varied("sh_degree", (2, 1, 0), low=0, high=3, integers=True),
    Varied("storage", (AUTO, 1.0, 3.0), low=0.01, high=64, words=(AUTO,)),
    Varied("mode", _MODES, words=_MODES),
    Varied("alpha_min", (0.008, 0.016, 0.032), low=1e-6, high=0.5),
    Varied("transmittance_min", (1e-3, 1e-2, 5e-2), low=1e-6, high=0.5),
    Varied("scale", (0.75, 0.5), low=0.05, high=1.0),
    Varied("supersampling", (1,), low=1, high=4, integers=True),
    Varied("field_step", (4.0, 16.0), low=1 / 64, high=1024),
    Varied("colour", _COLOURS, words=_COLOURS, trains=True),
    Varied("field", _FIELDS, words=_FIELDS, trains=True),
    Varied("field_size", (0.5, 0.25), low=1 / 64, high=64, trains=True),
    Varied("triangles", (0.5, 0.25), low=1 / 64, high=64, trains=True),
)


Settings = Mapping[str, Value | None]
"""The settings that a run has, as in ``Variant``, with its own values."""


def is_change(own: Settings, setting: Varied, value: Value) -> bool:
    """Whether a value applies to a run with the settings ``own`` and differs from its own."""
    if setting.name not in own:
        return False
    before = own[setting.name]
    return value < before if setting.name == "sh_degree" else value != before  # pyright: ignore[reportOperatorIssue]


def parse_variations(words: Sequence[str], *, trains: bool) -> tuple[Varied, ...]:
    """Return the variations of ``--vary SETTING`` or ``--vary SETTING=VALUE,VALUE``; without any,
    all with defaults.

    ``trains``: settings that need training from scratch are allowed.
    """
    if not words:
        return tuple(setting for setting in SETTINGS if trains or not setting.trains)
    found: dict[str, Varied] = {}
    for word in words:
        name, equals, listed = word.partition("=")
        setting = next((s for s in SETTINGS if s.name == name), None)
        if setting is None:
            names = ", ".join(s.name for s in SETTINGS)
            raise DyngsError(f"--vary {printable(word, 60)}: no such setting; there are {names}")
        if setting.trains and not trains:
            raise DyngsError(
                f"--vary {printable(word, 60)}: each value needs training from scratch; add --train"
            )
        if name in found:
            raise DyngsError(f"--vary {name} is given twice; write --vary {name}=VALUE,VALUE")
        texts = re.split(r"\s*,\s*", listed.strip())
        values = tuple(setting.parsed(text) for text in texts) if equals else setting.values
        found[name] = replace(setting, values=tuple(dict.fromkeys(values)))
    return tuple(found.values())


def single_changes(settings: Sequence[Varied], own: Settings, finetune: int) -> list[Variant]:
    """Return one variant per setting and value that applies to a run; pruned and masked ones also
    with fine-tuning."""
    variants = []
    for setting in settings:
        name = setting.name
        for value in setting.values:
            if is_change(own, setting, value):
                variant = Variant(**{name: value})  # pyright: ignore[reportArgumentType]
                if name == "field_step":
                    variant = replace(variant, storage=AUTO)
                variants.append(variant)
                if finetune and name in ("prune", "mask_times"):
                    variants.append(replace(variant, finetune=finetune))
    return variants
