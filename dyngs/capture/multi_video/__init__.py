"""Several videos of one moment: offsets between their clocks, poses of cameras that stand, one capture of all."""
