"""Files for other programs: images, videos, Gaussians, meshes, pages; camera paths; scene edits."""
