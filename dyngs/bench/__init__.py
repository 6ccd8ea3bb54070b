"""Benchmarks: speed of the rasterizer and of training steps of dynamic models on this machine."""
