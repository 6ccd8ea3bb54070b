"""The static model: how Gaussians start, are optimised, multiply and are filtered."""
