"""People: body templates, motion, body fitting, avatars, detection and feed-forward networks."""
