"""Limits on the result: number of Gaussians, file size, frames per second, minutes."""
