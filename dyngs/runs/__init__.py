"""Run folders: checkpoints, logs, the lock, and how a run is opened."""
