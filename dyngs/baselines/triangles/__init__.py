"""BG-Triangle: curved triangles with sharp edges."""
