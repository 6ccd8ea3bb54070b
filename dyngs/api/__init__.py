"""Whole jobs for Python users: load, train, prune, predict."""
