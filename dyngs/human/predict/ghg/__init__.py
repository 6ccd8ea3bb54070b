"""An avatar from a few images, by a network over the atlas trained on other people (GHG, Kwon et
al. 2024).

``person`` prepares a capture, ``texel_maps`` maps its images to the atlas, ``network`` is the UNet
over these maps and makes Gaussians of its output.
"""
