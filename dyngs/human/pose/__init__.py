"""Pose maths: rotations, linear blend skinning, moved covariances."""
