"""Captures: posed pictures of a scene on disk, their readers, preparation, inspection and loading for training."""
