"""Captures in memory: `readers/` (one module per file layout), images, the image loader, synthetic
scenes."""
