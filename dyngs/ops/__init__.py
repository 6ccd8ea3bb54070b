"""Native kernels behind typed, differentiable torch ops; the only package that imports the compiled
core."""
