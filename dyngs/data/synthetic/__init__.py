"""Synthetic captures: a small ray tracer and the scenes that come with dyngs."""
