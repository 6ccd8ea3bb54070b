"""Trained models in one small file: quantised by how much the image may change, and
entropy-coded."""
