"""Scenes that move: canonical Gaussians and a deformation field over time."""
