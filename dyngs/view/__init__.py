"""Viewer: a local web page that shows scenes and running trainings."""
