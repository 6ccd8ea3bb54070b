"""Captures as values: `readers/` (one module per layout), images, the image loader, synthetic
scenes."""
