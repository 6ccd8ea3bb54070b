"""Fewer Gaussians for nearly the same pictures: what each is worth, and which may go."""
