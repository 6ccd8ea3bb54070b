"""Readers of captures, one module per format."""
