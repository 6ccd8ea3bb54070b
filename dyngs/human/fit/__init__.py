"""Fitting the body template to pictures of a person: one shape, one skeleton, a pose for every frame."""
