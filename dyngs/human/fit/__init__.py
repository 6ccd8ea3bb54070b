"""Fitting the body template to images of a person: one shape, one skeleton, a pose for every
frame."""
