"""An avatar from a few images, by a network over the atlas trained on other people (GHG, Kwon et
al. 2024)."""
