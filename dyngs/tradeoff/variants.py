"""What of a run is varied: a variant says what it changes, a knob what may be changed and how far."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from dyngs.errors import DyngsError, printable

Value = float | int | str
SEVERAL = "several"
"""In place of a knob's name, of combinations."""
AUTO = "auto"
"""Storage as coarse as ``dyngs export --format dyngs`` takes it by itself."""


@dataclass(frozen=True)
class Variant:
    """What is changed of a run; the defaults change nothing.

    Attributes:
        colour: ``colour.kind`` that it is trained anew with.
        field: ``model.deform.kind`` that it is trained anew with.
        field_size: how many times as many nodes, channels, neurons or frequencies the field has, trained anew.
        prune: share of the Gaussians removed, by ``sensitivity``.
        mask_times: key times of the masks of what is seen.
        finetune: training steps after these two.
        sh_degree: harmonics above it are dropped.
        storage: how much pictures may change by rounding, grey levels of 255, or "auto"; None: exact, float32.
        field_step: how many times as coarsely the field is rounded as ``storage`` has it.
        mode, alpha_min, transmittance_min: ``model.rasterize_mode`` and so on that it is drawn with.
        scale: sides of the pictures drawn over those shown.
    """

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

    @property
    def changes(self) -> dict[str, Value]:
        """What is not as in the run."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}

    @property
    def name(self) -> str:
        """For people."""
        words = (f"{key}={value:g}" if isinstance(value, float) else f"{key}={value}" for key, value in self._items())
        return " ".join(words) or "as it is"

    @property
    def slug(self) -> str:
        """For files; different for different variants."""
        exact = (f"{key}-{value!r}" if isinstance(value, float) else f"{key}-{value}" for key, value in self._items())
        return "_".join(exact) or "as_it_is"

    @property
    def knobs(self) -> tuple[str, ...]:
        """Names of the knobs that are turned; fine-tuning and the field's steps belong to those before them."""
        return tuple(key for key, _ in self._items() if key not in ("finetune", "field_step"))

    @property
    def knob(self) -> str:
        """The one knob that is turned, with what belongs to it; "" of the run itself, ``SEVERAL`` of combinations."""
        return SEVERAL if len(self.knobs) > 1 else " + ".join(self.changes)

    @property
    def stored(self) -> Variant:
        """The part that decides what lies on disk."""
        return replace(self, mode=None, alpha_min=None, transmittance_min=None, scale=1.0)

    @property
    def trained(self) -> Variant:
        """The part that is a training from the start."""
        return Variant(colour=self.colour, field=self.field, field_size=self.field_size)

    def merged(self, other: Variant) -> Variant:
        """This one with what ``other`` changes, too."""
        return replace(self, **other.changes)

    def to_json(self) -> dict[str, Value]:
        """What ``from_json`` reads."""
        return self.changes

    @staticmethod
    def from_json(changes: dict[str, Any]) -> Variant:
        """The variant with these changes. Raises TypeError where one is unknown."""
        return Variant(**changes)

    def _items(self) -> list[tuple[str, Value]]:
        return list(self.changes.items())


@dataclass(frozen=True)
class Setting:
    """Something that can be varied.

    Attributes:
        name: a field of ``Variant``.
        values: tried by default, stronger ones later.
        low, high: of numbers, both allowed; none at all where ``low > high``.
        words: allowed beside numbers.
        whole: numbers are whole.
        trains: every value but the run's own is a training from the start.
    """

    name: str
    values: tuple[Value, ...]
    low: float = 1.0
    high: float = 0.0
    words: tuple[str, ...] = ()
    whole: bool = False
    trains: bool = False

    @property
    def allowed(self) -> str:
        """For messages."""
        kind = "a whole number" if self.whole else "a number"
        number = [f"{kind} from {self.low:g} to {self.high:g}"] if self.low <= self.high else []
        return " or ".join([*number, *self.words])

    def parsed(self, text: str) -> Value:
        """The value that is written.

        Raises:
            DyngsError: not allowed.
        """
        if text in self.words:
            return text
        try:
            value = int(text) if self.whole else float(text)
        except ValueError:
            value = float("nan")
        if not self.low <= value <= self.high:
            raise DyngsError(f"--vary {self.name}={printable(text, 60)}: give {self.allowed}")
        return value


FIELDS = ("trajectory", "hexplane", "mlp", "control_nodes")
SETTINGS = (
    Setting("prune", (0.3, 0.5, 0.7, 0.85), low=0.01, high=0.99),
    Setting("mask_times", (6, 16), low=2, high=1000, whole=True),
    Setting("sh_degree", (2, 1, 0), low=0, high=3, whole=True),
    Setting("storage", (AUTO, 1.0, 3.0), low=0.01, high=64, words=(AUTO,)),
    Setting("mode", ("classic", "antialiased"), words=("classic", "antialiased")),
    Setting("alpha_min", (0.008, 0.016, 0.032), low=1e-6, high=0.5),
    Setting("transmittance_min", (1e-3, 1e-2, 5e-2), low=1e-6, high=0.5),
    Setting("scale", (0.75, 0.5), low=0.05, high=1.0),
    Setting("field_step", (4.0, 16.0), low=1 / 64, high=1024),
    Setting("colour", ("sh", "network", "auto"), words=("sh", "network", "auto"), trains=True),
    Setting("field", FIELDS, words=FIELDS, trains=True),
    Setting("field_size", (0.5, 0.25), low=1 / 64, high=64, trains=True),
)


@dataclass(frozen=True)
class Variation:
    """A knob and the values that are to be tried."""

    knob: Setting
    values: tuple[Value, ...]


@dataclass(frozen=True)
class RunSettings:
    """What a run is like, as far as knobs depend on it.

    Attributes:
        sh_degree: of its harmonics, 0 where a network colours it.
        mode, alpha_min, transmittance_min: it is drawn with.
        mask_times: key times that it has.
        colour: kind.
        field: kind of what moves something; None: nothing moves.
    """

    sh_degree: int
    mode: str
    alpha_min: float
    transmittance_min: float
    mask_times: int
    colour: str
    field: str | None

    def allows(self, knob: Setting, value: Value) -> bool:
        """The value makes sense and is not the run's own."""
        if knob.name == "sh_degree":
            return value < self.sh_degree  # pyright: ignore[reportOperatorIssue]
        if knob.name in ("mask_times", "field", "field_size", "field_step") and self.field is None:
            return False
        own = asdict(self) | {"scale": 1.0, "field_size": 1.0, "field_step": 1.0}
        return own.get(knob.name) != value


def parse_variations(words: Sequence[str], *, trains: bool) -> tuple[Variation, ...]:
    """What ``--vary`` asks for: KNOB, or KNOB=VALUE,VALUE; without any all knobs with their default values.

    Args:
        words: one per ``--vary``.
        trains: knobs that need training from the start are among all.

    Raises:
        DyngsError: an unknown knob, one twice, or a value that is not allowed.
    """
    if not words:
        return tuple(Variation(knob, knob.values) for knob in SETTINGS if trains or not knob.trains)
    found: dict[str, Variation] = {}
    for word in words:
        name, equals, listed = word.partition("=")
        knob = next((k for k in SETTINGS if k.name == name), None)
        if knob is None:
            raise DyngsError(
                f"--vary {printable(word, 60)}: no such knob; there are {', '.join(k.name for k in SETTINGS)}"
            )
        if knob.trains and not trains:
            raise DyngsError(f"--vary {printable(word, 60)}: this trains the run anew, several times; add --train")
        if name in found:
            raise DyngsError(f"--vary {name} is given twice; write --vary {name}=VALUE,VALUE")
        values = tuple(knob.parsed(text) for text in re.split(r"\s*,\s*", listed.strip())) if equals else knob.values
        found[name] = Variation(knob, tuple(dict.fromkeys(values)))
    return tuple(found.values())


def single_changes(settings: Sequence[Variation], traits: RunSettings, finetune: int) -> list[Variant]:
    """One variant per knob and value that makes sense for a run; what is pruned or masked also with fine-tuning.

    Args:
        settings: knobs and values.
        traits: of the run.
        finetune: steps; 0: without.
    """
    variants = []
    for setting in settings:
        for value in setting.values:
            if traits.allows(setting.knob, value):
                variant = Variant(**{setting.knob.name: value})  # pyright: ignore[reportArgumentType]
                if setting.knob.name == "field_step":
                    variant = replace(variant, storage=AUTO)
                variants.append(variant)
                if finetune and setting.knob.name in ("prune", "mask_times"):
                    variants.append(replace(variant, finetune=finetune))
    return variants
