"""Limits of a run: a number of Gaussians, megabytes, minutes."""
