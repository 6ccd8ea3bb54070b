"""Export of people with their skeleton: skinned textured meshes, and Gaussians with joints."""
