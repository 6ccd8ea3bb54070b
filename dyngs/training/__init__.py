"""The plan of a run, the trainer, the loop and its events, corrections of images, priors."""
