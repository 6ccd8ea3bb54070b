"""Camera paths, render jobs, and the images, videos and contact sheets that they become."""
