"""Cameras, conventions of coordinates, errors, named tensors and image metrics."""
