"""Moving scenes: canonical Gaussians and a deformation field over time."""
