<<<<<<< HEAD
"""Pose maths: rotations, linear blend skinning."""
=======
"""Body templates, their texture atlas, and skinning."""
>>>>>>> main
