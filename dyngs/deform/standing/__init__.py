"""Motion before cameras that stand still: changes in their pictures, hulls, and tracks over time."""
