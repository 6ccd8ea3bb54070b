"""Several videos of one time step: offsets between their clocks, poses of fixed cameras, one
capture of all."""
