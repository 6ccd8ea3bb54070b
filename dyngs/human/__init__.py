"""People: a body template, its motion, and Gaussians anchored on its skin."""
