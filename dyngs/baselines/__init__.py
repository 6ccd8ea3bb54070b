"""Radiance fields (NeRF, Instant-NGP) and BG-Triangle, for comparison on the same captures."""
