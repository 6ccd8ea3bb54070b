"""Rigid bodies in the images of one moving camera: detection, trajectories and rotations."""
