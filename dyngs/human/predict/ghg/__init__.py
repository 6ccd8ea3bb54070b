"""Avatars from a few images, by a network over the UV map trained on other people (GHG, Kwon et
al. 2024)."""
