"""Camera geometry: poses, pinhole matrices, what cameras look at, moving far-away scenes to the origin."""
