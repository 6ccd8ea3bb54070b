"""Files for other programs: the standard 3DGS .ply."""
