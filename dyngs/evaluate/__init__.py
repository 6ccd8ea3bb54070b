"""Metrics of runs over held-out views, regions, point tracks and time."""
