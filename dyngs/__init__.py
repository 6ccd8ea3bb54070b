"""dyngs: static, dynamic and human Gaussian splatting on a CPU-first differentiable rasterizer.

The public names are imported on first use, so that ``import dyngs`` alone stays free of torch.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from dyngs.api.calls import train
    from dyngs.api.load import load, read_capture
    from dyngs.cli.export import export
    from dyngs.compat.rendering import rasterization
    from dyngs.config import Config
    from dyngs.config.io import load_config
    from dyngs.core.camera import Cameras
    from dyngs.core.errors import DyngsError
    from dyngs.data.capture import Capture
    from dyngs.evaluate.report import evaluate
    from dyngs.export.choose_path import render_path
    from dyngs.export.splat_files import save
    from dyngs.gaussians import Gaussians
    from dyngs.gaussians.rendering import RenderOptions, contributions, render
    from dyngs.gaussians.scene import GaussianScene
    from dyngs.models.model import LossInput
    from dyngs.models.renderable import Rendering
    from dyngs.study.compare import compare

__version__ = "0.1.0"
__all__ = [
    "Cameras",
    "Capture",
    "Config",
    "DyngsError",
    "GaussianScene",
    "Gaussians",
    "LossInput",
    "RenderOptions",
    "Rendering",
    "compare",
    "contributions",
    "evaluate",
    "export",
    "load",
    "load_config",
    "rasterization",
    "read_capture",
    "render",
    "render_path",
    "save",
    "train",
]

_MODULES = {
    "Cameras": "dyngs.core.camera",
    "Capture": "dyngs.data.capture",
    "Config": "dyngs.config",
    "DyngsError": "dyngs.core.errors",
    "GaussianScene": "dyngs.gaussians.scene",
    "Gaussians": "dyngs.gaussians",
    "LossInput": "dyngs.models.model",
    "RenderOptions": "dyngs.gaussians.rendering",
    "Rendering": "dyngs.gaussians.rendering",
    "compare": "dyngs.study.compare",
    "contributions": "dyngs.gaussians.rendering",
    "evaluate": "dyngs.evaluate.report",
    "export": "dyngs.cli.export",
    "load": "dyngs.api.load",
    "load_config": "dyngs.config.io",
    "rasterization": "dyngs.compat.rendering",
    "read_capture": "dyngs.api.load",
    "render": "dyngs.gaussians.rendering",
    "render_path": "dyngs.export.choose_path",
    "save": "dyngs.export.splat_files",
    "train": "dyngs.api.calls",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'dyngs' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
