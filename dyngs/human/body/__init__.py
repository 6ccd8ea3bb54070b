"""Pose maths: rotations, linear blend skinning."""
