"""Edits of trained scenes: change of frame, cropping and merging."""
