"""Files whose checksum fits and whose contents do not: tensors and headers, mutated by somebody who
knows them."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from moving_scene import camera
from tiny_fields import ALL_KINDS, cloud, stirred_field, tiny_options
from torch import Tensor

from dyngs.config import NetworkColour, SceneModel
from dyngs.core.state import add_prefix, strip_roles
from dyngs.deform.fields import WindowedField, field_state
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.colour.training import NetworkTraining
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.models.static_section import StaticModel
from dyngs.runs.stored_file import (
    Coding,
    assemble_file,
    encode_tensor,
)

Tensors = dict[str, Tensor]
Header = dict[str, Any]
CONTENTS = ("static", "network", "masked", "windowed", *ALL_KINDS)
_ROWS = (0, 2, 3, 6)

_VALUES = (torch.nan, torch.inf, -torch.inf, 3e38, -3e38, 1e20, 1e-45, -1.0, 0.0, 1e9, 255.0)
_TYPES = (
    torch.float64,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.uint8,
    torch.bool,
)
_WRONG = (
    None,
    "",
    "x" * 300,
    -1,
    0,
    2**70,
    1e308,
    float("nan"),
    float("inf"),
    True,
    [],
    {},
    [[1]],
    "\x00\n\x1b[31m",
)


def forged(
    tensors: Mapping[str, Tensor], header: Mapping[str, Any], chance: random.Random
) -> tuple[Tensors, Header]:
    """The contents of a file with one to three things wrong."""
    changed = {name: x.clone() for name, x in tensors.items()}
    told = dict(header)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        if chance.random() < 0.15:
            key = chance.choice(sorted(told)) if told else "step"
            if chance.random() < 0.2:
                told.pop(key, None)
            else:
                told[key] = chance.choice(_WRONG)
        elif changed:
            _change(changed, chance.choice(sorted(changed)), chance)
    return changed, told


def _change(tensors: Tensors, name: str, chance: random.Random) -> None:
    x = tensors[name]
    changes: list[Callable[[], Tensor | None]] = [
        lambda: None,
        lambda: x.to(chance.choice(_TYPES)),
        lambda: x.reshape(-1),
        lambda: x[None],
        lambda: x[..., None],
        lambda: x[:-1] if x.ndim else x[None],
        lambda: x[:0] if x.ndim else x[None][:0],
        lambda: torch.cat([x, x[-1:]]) if x.ndim else x,
        lambda: torch.cat([x, x]) if x.ndim else x,
        lambda: x[..., :-1].contiguous() if x.ndim else x,
        lambda: torch.cat([x, x[..., -1:]], dim=-1) if x.ndim else x,
        lambda: x.transpose(0, -1).contiguous() if x.ndim > 1 else x.flip(0) if x.ndim else x,
        lambda: x.reshape(-1)[:1].reshape(()) if x.numel() else x,
        lambda: torch.full_like(x, _fitting(chance, x)),
        lambda: torch.zeros_like(x),
        lambda: _with_value(x, _fitting(chance, x), chance),
        lambda: _with_value(x, _fitting(chance, x), chance),
        lambda: _with_value(x, _fitting(chance, x), chance),
        lambda: tensors[chance.choice(sorted(tensors))].clone(),
    ]
    made = chance.choice(changes)()
    if made is None:
        del tensors[name]
        if chance.random() < 0.3:
            tensors[f"{name}{chance.choice('0x.')}"] = x
    else:
        tensors[name] = made.contiguous()


def _fitting(chance: random.Random, x: Tensor) -> float | int:
    """A value that ``x`` can hold."""
    if x.is_floating_point():
        return chance.choice(_VALUES)
    return (
        chance.choice((-1, 0, 1, 7, 255, 2**31 - 1, 2**62, -(2**62)))
        if x.dtype == torch.int64
        else chance.choice((0, 1))
    )


def _with_value(x: Tensor, value: float, chance: random.Random) -> Tensor:
    if x.numel():
        x.view(-1)[chance.randrange(x.numel())] = value
    return x


def stored_as_they_are(tensors: Mapping[str, Tensor], info: Mapping[str, Any]) -> bytes:
    """The bytes of a ``scene.dyngs`` of any tensors, for a reader to judge.

    Raises:
        ValueError: the format cannot say that.
    """
    kept = {name: x for name, x in tensors.items() if x.dtype != torch.bfloat16}
    stored = [encode_tensor(name, x, Coding("exact")) for name, x in sorted(kept.items())]
    return assemble_file(dict(info), [entry for entry, _ in stored], [block for _, block in stored])


def require_drawable(scene: GaussianScene) -> None:
    """Nothing, if the images of a scene are finite; raises what drawing it raises."""
    for time in (None, 0.0, 0.37, 1.0):
        for options in (RenderOptions(), RenderOptions(near=0.01, depth="expected")):
            drawn = scene.render(camera(), time, options=options, background=torch.ones(3))
            assert bool(drawn.rgb.isfinite().all()), "an image is not finite"


def one_line(error: Exception, path: Path) -> None:
    """Assert that the message is one line of printable characters. It names the file or the reason
    why a scene is not drawn."""
    text = str(error)
    assert text.isprintable(), text
    assert (
        str(path) in text or "render" in text or "clean the input" in text or "not finite" in text
    ), text


def contents(kind: str) -> tuple[Tensors, SceneModel]:
    """Of a checkpoint of nine Gaussians: "static", "network", "masked", "windowed", or a field's
    kind; and its model."""
    gaussians = cloud(9)
    model = StaticModel()
    state: Tensors = {"filter_std": torch.rand(9, generator=torch.Generator().manual_seed(1))}
    if kind == "network":
        gaussians = gaussians.replace(sh=gaussians.sh[:, :1].contiguous())
        box = torch.stack([torch.zeros(3), torch.ones(3)])
        options = NetworkColour(width=8, depth=2)
        colours = NetworkTraining(
            options, 10, box, torch.Generator().manual_seed(0), uses_time=True
        )
        state |= strip_roles(add_prefix("colour", colours.network.state() | colours.state()))
    elif kind != "static":
        name = "control_nodes" if kind in ("masked", "windowed") else kind
        model = DynamicModel(deform=tiny_options(name))
        field = stirred_field(name, len(_ROWS))
        field = WindowedField(field, len(_ROWS)) if kind == "windowed" else field
        state |= strip_roles(add_prefix("field", field_state(field)))
        state |= {
            "rows": torch.tensor(_ROWS),
            "times": torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64),
        }
    if kind == "masked":
        masks = VisibilityMasks.pack(
            (0.0, 0.5, 1.0), torch.arange(9)[None] % 3 == torch.arange(3)[:, None]
        )
        state |= strip_roles(add_prefix("masks", masks.state()))
    tensors = {f"gaussians.{name}": x for name, x in gaussians.tensors().items()}
    return {
        name: x.contiguous()
        for name, x in (tensors | {f"model.{n}": x for n, x in state.items()}).items()
    }, model
