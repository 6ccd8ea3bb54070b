"""Pruning (4DGS-1K), cleaning, and storage precision of the file `scene.dyngs`."""
