"""The viewer: a local page that shows scenes and training."""
