"""Differentiable torch ops on the compiled core; the only package that imports it."""
