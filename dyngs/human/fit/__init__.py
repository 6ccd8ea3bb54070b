"""Fitting a body template to images of a person: one shape, one skeleton, and a pose per frame."""
