"""Whole jobs, as commands and Python programs ask for them: train a run, prune one, predict a
person, load a scene."""
