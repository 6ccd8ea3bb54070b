"""Inspection of captures: what one holds and everything that looks wrong about it."""
