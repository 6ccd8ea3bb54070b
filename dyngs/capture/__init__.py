"""Preparation of captures: structure from motion, initial points, masks, inspection, videos."""
