"""Corrections of a capture that training finds: exposure, cameras, and masks of what disagrees."""
