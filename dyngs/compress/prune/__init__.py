<<<<<<< HEAD
"""Fewer Gaussians for nearly the same images: importance scores, selection and fine-tuning."""
=======
"""Pruning by importance and visibility masks over time (4DGS-1K)."""
>>>>>>> main
