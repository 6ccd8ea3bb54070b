"""Speed on this machine: the rasterizer alone, and the training steps of dynamic models."""
