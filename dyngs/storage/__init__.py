"""Trained models in one small file: quantised by how much the picture may change, and entropy-coded."""
