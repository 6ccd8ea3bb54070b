"""Limits of a run: number of Gaussians, file size, training time."""
