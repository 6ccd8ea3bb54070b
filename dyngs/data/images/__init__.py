"""Images and videos: decoding, lens undistortion, silhouettes, the cache of video frames."""
