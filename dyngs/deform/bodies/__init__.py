"""Things that move rigidly, found in the images of one moving camera: where they are, and how they
turn."""
