"""dyngs: static, dynamic and human Gaussian splatting on a CPU-first differentiable rasterizer.

The public names are imported on first use, so that ``import dyngs`` alone stays free of torch.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from dyngs.api.load import load, read_capture
    from dyngs.api.train import train
    from dyngs.compat.rendering import rasterization
    from dyngs.config.io import load_config
    from dyngs.core.camera import Cameras
    from dyngs.core.errors import DyngsError
    from dyngs.gaussians import Gaussians
    from dyngs.gaussians.rendering import RenderOptions, contributions, render
    from dyngs.gaussians.scene import GaussianScene
    from dyngs.models.renderable import Rendering

__version__ = "0.1.0"
__all__ = [
    "Cameras",
    "DyngsError",
    "GaussianScene",
    "Gaussians",
    "RenderOptions",
    "Rendering",
    "contributions",
    "load",
    "load_config",
    "rasterization",
    "read_capture",
    "render",
    "train",
]

_MODULES = {
    "Cameras": "dyngs.core.camera",
    "DyngsError": "dyngs.core.errors",
    "GaussianScene": "dyngs.gaussians.scene",
    "Gaussians": "dyngs.gaussians",
    "RenderOptions": "dyngs.gaussians.rendering",
    "Rendering": "dyngs.gaussians.rendering",
    "contributions": "dyngs.gaussians.rendering",
    "load": "dyngs.api.load",
    "load_config": "dyngs.config.io",
    "rasterization": "dyngs.compat.rendering",
    "read_capture": "dyngs.api.load",
    "render": "dyngs.gaussians.rendering",
    "train": "dyngs.api.train",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'dyngs' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_MODULES[name]), name)
