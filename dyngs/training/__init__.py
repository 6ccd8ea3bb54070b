"""Training and evaluation: the loop, its schedules, checkpoints, logs and metrics."""
