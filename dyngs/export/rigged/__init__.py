"""People with their skeleton in files of other programs: skinned, textured meshes, and Gaussians
with joints."""
