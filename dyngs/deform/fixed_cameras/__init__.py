"""Motion before cameras that stand still: changes in their images, hulls, and tracks over time."""
