"""Run folders: checkpoints, logs, the lock."""
