"""A person from a few pictures, by a network over the atlas that was trained on other people (GHG, Kwon et al. 2024).

The way to an avatar without training on the person: ``maps`` brings the pictures to the atlas, ``network`` fills it,
``fill`` makes Gaussians of it.
"""
