"""Compact colour: a shared colour network, and SH coefficients only where they improve images."""
