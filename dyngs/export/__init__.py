"""Export of images, videos, Gaussians, meshes and web pages; camera paths; scene edits."""
