"""Quality, speed and size of a run with other settings, measured, and the best run that meets
requirements."""
