"""Radiance fields: functions of place and direction, drawn along rays. ``ngp`` looks them up, ``nerf`` computes them.

``space``: where a capture's field lies, and rays of its cameras. ``field``: what both have in common. ``ngp``,
``occupancy``: hash grid and small networks, and the cells that are not empty. ``nerf``: two large networks. ``scene``,
``training``, ``kind``: the seam. ``mesh``: a surface of equal density.
"""
