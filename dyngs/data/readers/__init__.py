"""Readers of captures, one module per format; each declares its ``FORMAT``, listed in
``dyngs.data.read``."""
