"""Structure from motion by COLMAP: photos, a video of a moving camera, or videos of fixed cameras."""
