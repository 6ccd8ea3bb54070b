"""Synthetic captures of dressed people."""
