"""Priors that a user gives with a capture, as losses in training; each is first compared with the
images."""
