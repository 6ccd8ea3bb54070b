"""Safe reading of untrusted files, atomic writing, and `formats/`: files of Gaussians."""
