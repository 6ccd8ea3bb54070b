"""Limits on the result: number of Gaussians, file size, minutes."""
