<<<<<<< HEAD
"""Limits on the result: number of Gaussians, file size, minutes."""
=======
"""Limits of a run: a number of Gaussians, megabytes, minutes."""
>>>>>>> main
