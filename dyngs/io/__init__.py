<<<<<<< HEAD
"""Files: untrusted ones are read within limits, our own are written atomically."""
=======
"""Safe reading of untrusted files, atomic writing, and `formats/`: files of Gaussians."""
>>>>>>> main
