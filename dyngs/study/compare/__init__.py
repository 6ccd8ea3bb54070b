"""Several models on one bench: trained on one capture with the same time, steps or size, and
compared."""
