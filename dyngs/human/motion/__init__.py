"""Motion of a body: files, retargeting, clips."""
