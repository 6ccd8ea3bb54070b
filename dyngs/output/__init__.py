"""Camera paths, render jobs, and the pictures, videos and contact sheets that they become."""
