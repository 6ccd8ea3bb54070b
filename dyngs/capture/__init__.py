"""Preparation of captures: camera poses and sparse points, by COLMAP."""
