"""dyngs: static, dynamic and human Gaussian splatting on a CPU-first differentiable rasterizer."""

__version__ = "0.1.0"
