"""A person found in a clip: detectors of other programs, one person followed, silhouettes and key
points."""
