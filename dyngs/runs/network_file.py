"""Weights of a network in one file, to be published: what `dyngs predict` needs, without the run.

Weights are stored as float16, and the section ``model`` of the configuration with them.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.util import find_spec
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
PUBLISHED = "dyngs_people_weights"
"""Package of weights that are known by a name; packaging/weights makes it."""

_KIND = FileKind("dyngs network", "the weights of a network", 1)
_ADVICE = "; write it again with `dyngs export NET_RUN --format network`"
_PARTS = "model."  # Of a checkpoint, what is no state of its training


def write_network(run_dir: Path, config: Config, checkpoint: Checkpoint, path: Path) -> Path:
    """Write the network of a run; return ``path``.

    Raises DyngsError: values that float16 cannot hold, a body template of the user's own, or a path
    that is an input.
    """
    if path.suffix.lower() != SUFFIX:
        raise DyngsError(f"{path}: a network is written as {SUFFIX}")
    collect_inputs(run_dir).require_output(path)
    if getattr(config.model, "body", None) is not None:
        raise DyngsError(
            f"{run_dir}: a file of a network holds no template, and model.body names one; give the run"
        )
    tensors = {name: x for name, x in checkpoint.tensors.items() if name.startswith(_PARTS)}
    small = {
        name: x.half().contiguous() if x.is_floating_point() else x for name, x in tensors.items()
    }
    for name, x in small.items():
        if not bool(torch.isfinite(x).all()):
            raise DyngsError(
                f"{run_dir}: {name.removeprefix(_PARTS)} is beyond what float16 holds; lower model.lr"
            )
    write_tensors(
        path,
        _KIND,
        small,
        {**asdict(checkpoint.info), "model": config.model.model_dump(mode="json")},
    )
    return path


def read_network(path: Path) -> tuple[Config, Checkpoint]:
    """Return the configuration and the weights of a file; the configuration names no capture.

    Raises DyngsError: the file is missing, damaged, altered or something else.
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
    """Return the file of the weights ``name`` in the package of published ones. Raises DyngsError:
    it is not there."""
    package = find_spec(PUBLISHED)
    if package is None:
        advice = "install the package dyngs-people-weights, see docs/people_network.md, to use published weights"
        raise DyngsError(
            f"{name}: no run and no file of weights; give the run of a network, or {advice}"
        )
    files = {
        x.stem: x
        for folder in package.submodule_search_locations or ()
        for x in Path(folder).glob(f"*{SUFFIX}")
    }
    if name not in files:
        raise DyngsError(
            f"{name}: no run and no file of weights; published are {' and '.join(sorted(files)) or 'none'}"
        )
    return files[name]
