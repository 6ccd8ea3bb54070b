"""Pruning by importance and visibility masks over time (4DGS-1K)."""
