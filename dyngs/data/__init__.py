"""Captures: posed images of a scene on disk, their readers, preparation, inspection and loading for
training."""
