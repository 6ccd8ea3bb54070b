"""Radiance fields: NeRF and Instant-NGP."""
