"""Motion in front of fixed cameras: changes in the images, visual hulls, and tracks over time."""
