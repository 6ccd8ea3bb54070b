"""Fewer Gaussians (4DGS-1K), cleaning, and the precision of the file `scene.dyngs`."""
