"""Files: untrusted ones are read within limits, our own are written atomically."""
