"""What people look at: camera paths, videos, contact sheets."""
