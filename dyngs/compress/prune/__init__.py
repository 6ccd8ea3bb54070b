"""Fewer Gaussians for nearly the same images: importance scores, selection and fine-tuning."""
