"""Evaluation of runs on held-out views."""
