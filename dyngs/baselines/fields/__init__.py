"""Radiance fields: functions of place and direction, drawn along rays. ``ngp`` looks them up,
``nerf`` computes them.

``space``: where a capture's field lies, and rays of its cameras. ``field``: what both have in
common. ``ngp``, ``occupancy``, ``frusta``, ``thinning``: hash grid and small networks, the cells
that are not empty, those that cameras see, and which samples count. ``nerf``: two large networks.
``scene``, ``training``, ``kind``: the seam. ``mesh``: a surface of equal density.
"""
