"""Curved triangles with sharp edges (BG-Triangle, Wu et al. 2025).

``patches``: quadratic Bezier triangles, their colours, and how one is cut into four. ``scene``: how
they are drawn. ``tallies``: what images say about each. ``densify``: which are split, which
removed. ``training``, ``kind``: the seam.
"""
