"""People: body templates, motion, fits, avatars, detection, and networks that predict people."""
