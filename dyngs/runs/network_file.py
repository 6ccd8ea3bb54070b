"""Weights file of a network for ``dyngs predict``: float16 weights and the config section
``model``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch

from dyngs.config import Config
from dyngs.config.io import drop_removed_model_keys
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.io.tensor_file import FileKind, read_tensors, write_tensors
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import PredictsScenes, capability
from dyngs.runs.checkpoint import parse_info
from dyngs.runs.folder import collect_inputs

SUFFIX = ".safetensors"
WEIGHTS = Path(__file__).parents[1] / "human" / "predict" / "weights"
"""Weights that come with dyngs, trained on synthetic people."""

_KIND = FileKind("dyngs network", "the weights of a network", 1)
_ADVICE = "; write it again with `dyngs export NET_RUN --format network`"
_PARTS = "model."  # prefix of the weights in a checkpoint, as opposed to training state


def write_network(run_dir: Path, config: Config, checkpoint: Checkpoint, path: Path) -> Path:
    """Write the weights of a run; return ``path``.

    Raises DyngsError: weights beyond float16, a custom body template, or a path that is an input.
    """
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(f"{path}: a network is written as {SUFFIX}")
    collect_inputs(run_dir).require_output(path)
    if getattr(config.model, "body", None) is not None:
        raise DyngsError(
            f"{run_dir}: networks with a custom template (model.body) cannot be exported; use the run"
        )
    tensors = {name: x for name, x in checkpoint.tensors.items() if name.startswith(_PARTS)}
    small = {
        name: x.half().contiguous() if x.is_floating_point() else x for name, x in tensors.items()
    }
    for name, x in small.items():
        if not bool(torch.isfinite(x).all()):
            raise DyngsError(
                f"{run_dir}: {name.removeprefix(_PARTS)} overflows float16; lower model.lr"
            )
    write_tensors(
        path,
        _KIND,
        small,
        {**asdict(checkpoint.info), "model": config.model.model_dump(mode="json")},
    )
    return path


def read_network(path: Path) -> tuple[Config, Checkpoint]:
    """Load the configuration (without a capture) and the weights of a file.

    Raises DyngsError: a missing, damaged or invalid file.
    """
    header, tensors = read_tensors(path, _KIND, _ADVICE)
    with wrap_read_errors(path, _ADVICE.removeprefix("; ")):
        info = parse_info(header)
        model = header["model"]
        if not isinstance(model, dict) or model.get("body") is not None:
            raise ValueError("its section model is not that of a network")
        model = drop_removed_model_keys(model)
        config = Config.model_validate({"data": {"root": path.parent}, "model": model})
        if capability(config.model, PredictsScenes) is None:
            raise ValueError(f"it is of model.kind={config.model.kind}")
    return config, Checkpoint(
        info, {n: x.float() if x.is_floating_point() else x for n, x in tensors.items()}, path
    )


def published_network(name: str) -> Path:
    """Return the file of weights that come with dyngs. Raises DyngsError: an unknown name."""
    path = WEIGHTS / f"{name}{SUFFIX}"
    if not path.is_file():
        names = " and ".join(sorted(file.stem for file in WEIGHTS.glob(f"*{SUFFIX}"))) or "none"
        raise DyngsError(
            f"{name}: no run and no file of weights; networks that come with dyngs: {names}; "
            "train others with `dyngs train`"
        )
    return path
