"""Camera paths: placed by cameras or points, smoothed, interpolated, read and written."""
