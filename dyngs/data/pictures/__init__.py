"""Pictures and videos: decoding, lens distortion, the cache of video frames."""
