"""Training: run plan, trainer, loop and events, image corrections and priors."""
