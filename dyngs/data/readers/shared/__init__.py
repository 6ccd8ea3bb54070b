"""Parts of readers: what several formats share, and checks that a reader does not hold itself."""
