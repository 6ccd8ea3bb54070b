"""The interface of gsplat 1.5: ``import dyngs.compat as gsplat``."""

from __future__ import annotations

from dyngs.compat import rendering as rendering
from dyngs.compat import strategy as strategy
from dyngs.compat.rendering import rasterization as rasterization
from dyngs.compat.strategy import DefaultStrategy as DefaultStrategy
from dyngs.compat.strategy import MCMCStrategy as MCMCStrategy
from dyngs.compat.strategy import Strategy as Strategy
