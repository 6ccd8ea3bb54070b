"""Fewer Gaussians for nearly the same pictures: importance scores, selection and fine-tuning."""
