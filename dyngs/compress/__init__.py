"""Fewer and smaller Gaussians: `prune/` (4DGS-1K) and `storage/` (the file `scene.dyngs`)."""
