"""Captures on disk: one reader per format, pictures, lenses and the loader that feeds training."""
